// Sessions by sessions: closures, or the best rejected hypothesis.

const MANY = 30; // sessions, from which on cells have no numbers

function pairTables() {
  const n = data.sessions.length;
  const counts = new Uint32Array(n * n);
  const rejected = new Int32Array(n * n).fill(-1);
  const { sessions, count } = data.closures;
  for (let k = 0; k < count; k++) counts[sessions[2 * k] * n + sessions[2 * k + 1]]++;
  for (let k = 0; k < data.rejected.count; k++) {
    if (!data.rejected.at_pair[k]) continue;
    rejected[data.rejected.sessions[2 * k] * n + data.rejected.sessions[2 * k + 1]] = k;
  }
  return { counts, rejected };
}

function buildMatrix() {
  const n = data.sessions.length;
  const { counts, rejected } = pairTables();
  const most = counts.reduce((a, b) => Math.max(a, b), 1);
  const cell = (q, t) => {
    const count = counts[q * n + t];
    const k = rejected[q * n + t];
    const names = `${data.sessions[q].name} in ${q === t ? "itself" : data.sessions[t].name}`;
    const td = el("td", { "data-cell": q * n + t, tabindex: q + t === 0 ? 0 : -1 });
    if (count) {
      td.textContent = count;
      td.style.background = `rgb(var(--high) / ${(0.18 + (0.5 * Math.log(1 + count)) / Math.log(1 + most)).toFixed(2)})`;
      td.title = `${names}: ${plural(count, "closure")}`;
    } else if (k >= 0) {
      td.textContent = data.rejected.probability[k].toFixed(2);
      td.className = "none";
      td.style.background = `rgb(var(--low) / ${(0.05 + 0.35 * data.rejected.probability[k]).toFixed(2)})`;
      td.title = `${names}: no closure; ${reasonText(data.rejected, k)}`;
    } else {
      const reason = data.excluded[`${Math.min(q, t)} ${Math.max(q, t)}`];
      td.textContent = reason ? "×" : "-";
      td.className = "none empty";
      td.title = reason ? `${names}: not searched; ${reason}` : `${names}: no hypothesis`;
    }
    return td;
  };
  const head = el("tr", {}, el("th", { scope: "col" }, el("span", { class: "unseen" }, "query in target")), data.sessions.map((s) => el("th", { scope: "col", title: s.name }, el("span", {}, s.name))));
  const rows = data.sessions.map((s, q) => el("tr", {}, el("th", { scope: "row", title: s.name }, s.name), data.sessions.map((_, t) => cell(q, t))));
  const grid = el("table", { class: n > MANY ? "grid many" : "grid", role: "grid", "aria-label": "Closures by query and target session" }, el("thead", {}, head), el("tbody", {}, rows));

  const act = (td) => {
    const at = Number(td.dataset.cell);
    const [q, t] = [Math.floor(at / n), at % n];
    if (counts[at]) {
      change({ either: -1, query: q, target: t, low: 0, from: "", to: "" });
      select("closure", state.shown[0]);
    } else if (rejected[at] >= 0) {
      select("rejected", rejected[at]);
    } else return;
    byId("picture").scrollIntoView();
  };
  grid.addEventListener("click", (e) => e.target.closest("td") && act(e.target.closest("td")));
  grid.addEventListener("keydown", (e) => {
    const td = e.target.closest("td");
    const moves = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] };
    if (!td) return;
    if (e.key === "Enter" || e.key === " ") {
      e.preventDefault();
      act(td);
    } else if (moves[e.key]) {
      e.preventDefault();
      const at = Number(td.dataset.cell);
      const q = Math.min(n - 1, Math.max(0, Math.floor(at / n) + moves[e.key][0]));
      const t = Math.min(n - 1, Math.max(0, (at % n) + moves[e.key][1]));
      const next = grid.querySelector(`[data-cell="${q * n + t}"]`);
      td.tabIndex = -1;
      next.tabIndex = 0;
      next.focus();
    }
  });
  byId("matrix-table").replaceChildren(grid);
}
