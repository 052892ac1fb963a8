// Puts the page together.

const data = readData();

function prepare() {
  const { probability, count } = data.closures;
  let [least, greatest] = [1, 0];
  for (let k = 0; k < count; k++) {
    least = Math.min(least, probability[k]);
    greatest = Math.max(greatest, probability[k]);
  }
  data.range = count ? { least, greatest } : { least: 0, greatest: 1 };
  data.groupBounds = data.groups.map((group) => {
    const box = { x0: Infinity, y1: -Infinity };
    for (const s of group) {
      const { xy } = data.sessions[s].drive;
      for (let k = 0; k < xy.length; k += 2) {
        box.x0 = Math.min(box.x0, xy[k]);
        box.y1 = Math.max(box.y1, xy[k + 1]);
      }
    }
    return box;
  });
  const roads = data.sessions.map((s) => s.road_m).filter((m) => m > 0);
  const places = data.rejected.at_query.reduce((a, b) => a + b, 0) + count;
  data.spacing = roads.length && places ? roads.reduce((a, b) => a + b, 0) / places : 1;
}

function showSummary() {
  const road = data.sessions.reduce((sum, s) => sum + (s.road_m || 0), 0);
  byId("summary").textContent = `${plural(data.sessions.length, "session")}, ${lengthText(road)} of road, ${plural(data.closures.count, "closure")}`;
  const n = data.groups.length;
  const how = data.optimised.length ? "Sessions lie by their optimised poses."
    : data.sessions.length > 1 ? "Sessions are laid on each other by their most probable closures; drift is not corrected." : "";
  const apart = n > 1 ? ` ${n} groups of sessions are not connected by closures: they are drawn beside each other, and only distances within a group mean something.` : "";
  byId("frame-note").textContent = how + apart;
}

function listenToTheme() {
  const button = byId("theme");
  const label = () => { button.textContent = isDark() ? "Light" : "Dark"; };
  button.setAttribute("aria-label", "Change between light and dark");
  button.addEventListener("click", () => {
    document.documentElement.dataset.theme = isDark() ? "light" : "dark";
    label();
    change({ theme: document.documentElement.dataset.theme });
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    label();
    change({ theme: "" });
  });
  label();
}

function start() {
  prepare();
  listenToTheme();
  buildFilters();
  change({ low: 0 });
  showSummary();
  buildLegend();
  const view = new MapView(byId("map"));
  globalThis.VIEW = view;
  document.querySelectorAll("[data-view]").forEach((button) => button.addEventListener("click", () => {
    const actions = { in: () => view.zoom(1.5), out: () => view.zoom(1 / 1.5), fit: () => view.fit() };
    actions[button.dataset.view]();
  }));
  sortClosures();
  showDetails();
  showClosures();
  onChange((names) => {
    if (names.has("shown")) sortClosures();
    if (names.has("selected")) {
      followSelected();
      announce();
      if (state.selected) view.show(rowsOf(state.selected), state.selected.index);
    }
    if (names.has("selected") || names.has("shown")) {
      showDetails();
      showClosures();
    }
    if (names.has("spread")) view.fit();
    view.draw();
  });
  // pictures come last in the file
  const ready = () => {
    view.draw();
    buildSessions();
    buildRun();
    requestAnimationFrame(() => setTimeout(buildMatrix));
  };
  if (document.readyState === "loading") document.addEventListener("DOMContentLoaded", ready);
  else ready();
}

function announce() {
  if (!state.selected) {
    byId("announce").textContent = "Nothing selected";
    return;
  }
  const { kind, index } = state.selected;
  const { sessions, times } = endsOf(rowsOf(state.selected), index);
  byId("announce").textContent = kind === "closure"
    ? `Closure ${index + 1}: ${sessions[0].name} at ${times[0]} in ${sessions[1].name} at ${times[1]}`
    : `No closure: ${sessions[0].name} at ${times[0]}: ${reasonText(data.rejected, index)}`;
}

start();
