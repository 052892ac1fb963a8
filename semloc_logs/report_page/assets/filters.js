// The filters, the legend and the layers.

function buildFilters() {
  const form = byId("filters");
  const names = () => data.sessions.map((s, k) => el("option", { value: k }, s.name));
  const chooser = (key, text) => el("label", {}, text,
    el("select", { "data-key": key, onchange: (e) => change({ [key]: Number(e.target.value) }) }, el("option", { value: -1 }, "all"), names()));
  const days = data.sessions.filter((s) => s.isDated).map((s) => dayText(s));
  const day = (key, text) => el("label", {}, text,
    el("input", { type: "date", "data-key": key, min: days.reduce((a, b) => (a < b ? a : b)), max: days.reduce((a, b) => (a > b ? a : b)), onchange: (e) => change({ [key]: e.target.value }) }));
  const { least, greatest } = data.range;
  const shown = el("span", {}, probabilityText(least));
  const slider = el("input", {
    type: "range", min: 0, max: 100, value: 0, "data-key": "low", "aria-label": "Least probability",
    oninput: (e) => {
      const share = Number(e.target.value) / 100;
      const low = share === 0 ? 0 : 1 - (1 - least) * ((1 - greatest + 1e-5) / (1 - least + 1e-5)) ** share;
      shown.textContent = probabilityText(Math.max(low, least));
      change({ low });
    },
  });
  form.append(
    chooser("either", "Session"), chooser("query", "Query"), chooser("target", "Target"),
    el("label", {}, el("span", {}, "Probability from ", shown), slider));
  if (days.length) form.append(day("from", "From (UTC)"), day("to", "To (UTC)"));
  form.append(el("button", { type: "button", onclick: resetFilters }, "Clear filters"), el("span", { id: "count", class: "soft", role: "status" }));
  form.addEventListener("submit", (e) => e.preventDefault());
  onChange((names) => {
    if (names.has("shown")) byId("count").textContent = `${state.shown.length.toLocaleString("en")} of ${plural(data.closures.count, "closure")}`;
    for (const key of ["either", "query", "target", "from", "to"]) {
      if (names.has(key)) form.querySelectorAll(`[data-key="${key}"]`).forEach((node) => { node.value = state[key]; });
    }
    if (names.has("low") && state.low === 0) {
      slider.value = 0;
      shown.textContent = probabilityText(least);
    }
  });
}

function resetFilters() {
  change({ either: -1, query: -1, target: -1, low: 0, from: "", to: "" });
}

function buildLegend() {
  const { least, greatest } = data.range;
  const legend = byId("legend");
  const few = data.sessions.length <= SESSION_COLOURS.length;
  const draw = () => {
    const drives = data.sessions.slice(0, few ? data.sessions.length : 0).map((session, s) => {
      const swatch = el("span", { class: "swatch" });
      swatch.style.background = sessionColour(s);
      return el("span", { class: "key" }, swatch, session.name);
    });
    legend.replaceChildren(
      el("span", { class: "key" }, "closures, probability ", probabilityText(least), el("span", { class: "ramp", "aria-hidden": "true" }), probabilityText(greatest)),
      el("span", { class: "key" }, el("span", { class: "ring" }), "place without closure"),
      ...(few ? drives : [el("span", { class: "key" }, "each drive has a colour; its name is below the pointer")]));
  };
  draw();
  onChange((names) => names.has("theme") && draw());

  const titles = { maps: "maps", drives: "drives", closures: "closures", places: "places without closure" };
  const layers = byId("layers");
  for (const [name, title] of Object.entries(titles)) {
    const box = el("input", { type: "checkbox", checked: state.layers[name], onchange: (e) => change({ layers: { ...state.layers, [name]: e.target.checked } }) });
    layers.append(el("label", { class: "check" }, box, title));
  }
  if (data.sessions.length > 1) {
    layers.append(el("label", { class: "check" }, "spread sessions apart",
      el("input", { type: "range", min: 0, max: 100, value: 0, "aria-label": "Spread sessions apart, in the order of recording", oninput: (e) => change({ spread: Number(e.target.value) / 100 }) })));
  }
}
