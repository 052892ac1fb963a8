// The tables: closures page by page, sessions, the run, settings and versions.

const PAGE = 25; // rows

const closureList = { page: 0, key: "number", isDown: false, rows: [] };

const COLUMNS = [
  { key: "number", title: "No.", number: true, value: (k) => k },
  { key: "query", title: "Query", value: (k) => data.closures.sessions[2 * k] },
  { key: "query time", title: "at", value: (k) => data.sessions[data.closures.sessions[2 * k]].start + data.closures.t[2 * k] },
  { key: "target", title: "Target", value: (k) => data.closures.sessions[2 * k + 1] },
  { key: "target time", title: "at", value: (k) => data.sessions[data.closures.sessions[2 * k + 1]].start + data.closures.t[2 * k + 1] },
  { key: "probability", title: "Probability", number: true, value: (k) => data.closures.probability[k] },
  { key: "apart", title: "Apart", number: true, value: (k) => Math.hypot(data.closures.pose[3 * k], data.closures.pose[3 * k + 1], data.closures.height[k]) },
  { key: "yaw", title: "Yaw", number: true, value: (k) => data.closures.pose[3 * k + 2] },
  { key: "sigma", title: "1 sigma", number: true, value: (k) => Math.hypot(data.closures.sigma[6 * k], data.closures.sigma[6 * k + 1], data.closures.sigma[6 * k + 2]) },
  { key: "overlap", title: "Overlap", number: true, value: (k) => data.closures.overlap[k] },
];

function sortClosures() {
  const { value } = COLUMNS.find((c) => c.key === closureList.key);
  const sign = closureList.isDown ? -1 : 1;
  closureList.rows = [...state.shown].sort((a, b) => sign * (value(a) - value(b)) || a - b);
}

function showClosures() {
  const { rows } = closureList;
  const pages = Math.max(1, Math.ceil(rows.length / PAGE));
  closureList.page = Math.min(closureList.page, pages - 1);
  const first = closureList.page * PAGE;
  const head = COLUMNS.map(({ key, title, number }) => {
    const isSorted = key === closureList.key;
    const order = isSorted ? (closureList.isDown ? "descending" : "ascending") : undefined;
    const sort = () => {
      Object.assign(closureList, { key, isDown: isSorted ? !closureList.isDown : false, page: 0 });
      sortClosures();
      showClosures();
    };
    return el("th", { scope: "col", class: number && "number", "aria-sort": order }, el("button", { type: "button", onclick: sort, "aria-label": `Sort by ${key}` }, title, isSorted ? (closureList.isDown ? " ▾" : " ▴") : ""));
  });
  const cells = (k) => {
    const { sessions, isSelf } = endsOf(data.closures, k);
    const value = (key) => COLUMNS.find((c) => c.key === key).value(k);
    return [
      el("button", { type: "button", "data-closure": k, onclick: () => select("closure", k), "aria-label": `Show closure ${k + 1}` }, String(k + 1)),
      sessions[0].name, timeText(sessions[0], data.closures.t[2 * k]),
      isSelf ? "itself" : sessions[1].name, timeText(sessions[1], data.closures.t[2 * k + 1]),
      probabilityText(value("probability")), lengthText(value("apart")), degreesText(value("yaw")), lengthText(value("sigma")), value("overlap").toFixed(2),
    ];
  };
  const selected = state.selected && state.selected.kind === "closure" ? state.selected.index : -1;
  const body = rows.slice(first, first + PAGE).map((k) => el("tr", { class: k === selected && "selected" }, cells(k).map((c, i) => el("td", { class: COLUMNS[i].number && "number" }, c))));
  const turn = (page) => () => {
    closureList.page = page;
    showClosures();
  };
  byId("closure-table").replaceChildren(
    rows.length ? el("div", { class: "scroll" }, el("table", { "aria-label": "Closures that pass the filters" }, el("thead", {}, el("tr", {}, head)), el("tbody", {}, body)))
      : el("p", {}, data.closures.count ? "No closure passes the filters." : "This workspace has no closures."),
    el("div", { class: "pages" },
      el("button", { type: "button", onclick: turn(closureList.page - 1), disabled: closureList.page === 0 }, "Previous page"),
      el("span", {}, `page ${closureList.page + 1} of ${pages}`),
      el("button", { type: "button", onclick: turn(closureList.page + 1), disabled: closureList.page >= pages - 1 }, "Next page")));
}

/** Turn to the page of the selected closure. */
function followSelected() {
  if (!state.selected || state.selected.kind !== "closure") return;
  const at = closureList.rows.indexOf(state.selected.index);
  if (at >= 0) closureList.page = Math.floor(at / PAGE);
}

// -- sessions

function buildSessions() {
  const counts = new Uint32Array(data.sessions.length);
  const { sessions, count } = data.closures;
  for (let k = 0; k < count; k++) {
    counts[sessions[2 * k]]++;
    if (sessions[2 * k + 1] !== sessions[2 * k]) counts[sessions[2 * k + 1]]++;
  }
  const columns = [{ title: "Session" }, { title: "Recorded (UTC)" }, { title: "Time", number: true }, { title: "Road", number: true }, { title: "Group", number: true }, { title: "Closures", number: true }, { title: "Labels" }, { title: "Poses" }, { title: "Log and streams" }, { title: "Warnings" }];
  const rows = data.sessions.map((s, k) => [
    s.name, timeText(s, 0), durationText(s.duration_s), s.posed ? lengthText(s.road_m) : "-",
    data.groupOf[k] < 0 ? "-" : String(data.groupOf[k] + 1), counts[k].toLocaleString("en"), s.label_source,
    poseText(s), logCell(s), warningCell(s),
  ]);
  byId("session-table").replaceChildren(table(columns, rows, { "aria-label": "Sessions" }));
}

function poseText(s) {
  if (!s.posed) return "none";
  const gaps = (s.poses.gaps || []).length;
  return `${s.pose_source || "log"}, up from ${s.up || "?"}${gaps ? `, ${plural(gaps, "gap")}` : ""}`;
}

function logCell(s) {
  const files = s.logs.map((log) => log.file).join(", ");
  const streams = s.streams.map(([role, topic, type, count]) => [role, topic, type, Number(count || 0).toLocaleString("en")]);
  return el("details", {}, el("summary", {}, files || "log"),
    facts([["format", s.logs.map((l) => l.format).join(", ")], ["keyframes", s.keyframes.toLocaleString("en")], ["voxels", `${Number(s.voxels || 0).toLocaleString("en")} of ${s.voxel_size} m`], ["base frame", s.base_frame || "-"], ["session frame", s.session_frame || "-"], ["made with version", s.version || "-"]]),
    table([{ title: "Role" }, { title: "Topic" }, { title: "Type" }, { title: "Messages", number: true }], streams));
}

function warningCell(s) {
  const texts = [...s.misfits, ...s.warnings];
  if (!texts.length) return "none";
  return el("details", {}, el("summary", {}, plural(texts.length, "warning")), texts.map((text) => el("p", { class: "warn" }, text)));
}

// -- run

function settingText(value) {
  if (value === null) return "-";
  if (typeof value === "number" && !Number.isInteger(value)) return String(Number(value.toPrecision(8)));
  return typeof value === "object" ? JSON.stringify(value) : String(value);
}

function buildRun() {
  const parts = [];
  const seconds = Object.entries(data.run.seconds || {});
  parts.push(el("div", {}, el("h3", {}, "Last run"),
    seconds.length ? facts(seconds.map(([stage, s]) => [stage, durationText(s)])) : el("p", {}, "semloc run has not written its timings here."),
    facts([["semloc", data.version], ["version of the run", data.run.version || "-"]])));
  const left = [...new Set([...data.exclusions, ...(data.run.skipped || []), ...data.failed.map((f) => `${f.session}: ${f.reason}`)])];
  parts.push(el("div", {}, el("h3", {}, "Input that was left out"), left.length ? left.map((text) => el("p", { class: "warn" }, text)) : el("p", {}, "none")));
  const groups = Object.entries(data.settings).map(([section, values]) =>
    el("details", {}, el("summary", {}, section), facts(Object.entries(values).map(([key, value]) => [key, settingText(value)]))));
  parts.push(el("div", {}, el("h3", {}, "Settings of the tables"), groups.length ? groups : el("p", {}, "not known")));
  byId("run-tables").replaceChildren(...parts);
}
