// The selected closure, or the place without one: figures, pictures, evidence, votes.

const PICTURE = 340; // pixels along an edge of the pictures that are drawn here
const REACH = 75; // voxels around the query that they show
const SIGMAS = 2; // that the ellipse shows
const TINTS = { query: "rgb(214 120 20 / 0.55)", target: "rgb(20 90 200 / 0.45)" };

function showDetails() {
  const panel = byId("details");
  if (!state.selected) {
    panel.replaceChildren(...overview());
    return;
  }
  const { kind, index } = state.selected;
  panel.replaceChildren(...(kind === "closure" ? closureDetails(index) : rejectedDetails(index)));
}

function overview() {
  const { count } = data.closures;
  const places = data.rejected.at_query.reduce((sum, x) => sum + x, 0);
  return [
    el("h3", {}, "Nothing selected"),
    el("p", {}, "Click a closure on the map or in the list below. A ring is a place without a closure: a click tells why."),
    facts([
      ["closures shown", `${state.shown.length.toLocaleString("en")} of ${count.toLocaleString("en")}`],
      ["places without closure", places.toLocaleString("en")],
    ]),
    el("div", { class: "steps" },
      el("button", { type: "button", onclick: () => selectNext(1), disabled: !state.shown.length }, "First closure")),
  ];
}

function endsOf(rows, k) {
  const numbers = [rows.sessions[2 * k], rows.sessions[2 * k + 1]];
  const sessions = numbers.map((s) => data.sessions[s]);
  const times = sessions.map((session, end) => timeText(session, rows.t[2 * k + end]));
  return { numbers, sessions, times, isSelf: numbers[0] === numbers[1] };
}

function steps() {
  return el("div", { class: "steps" },
    el("button", { type: "button", onclick: () => selectNext(-1) }, "Previous"),
    el("button", { type: "button", onclick: () => selectNext(1) }, "Next"),
    el("button", { type: "button", onclick: () => select(null) }, "Close"));
}

function closureDetails(k) {
  const rows = data.closures;
  const { sessions, times, isSelf } = endsOf(rows, k);
  const [x, y, yaw] = rows.pose.slice(3 * k, 3 * k + 3);
  const z = rows.height[k];
  const sigma = rows.sigma.slice(6 * k, 6 * k + 6);
  const width = data.features.length + data.votes.length + data.factors.length;
  const evidence = rows.evidence.slice(width * k, width * (k + 1));
  const features = evidence.slice(0, data.features.length);
  const votes = evidence.slice(data.features.length, width - data.factors.length);
  const factors = evidence.slice(width - data.factors.length);
  const out = [
    el("h3", {}, `Closure ${k + 1}: ${sessions[0].name} in ${isSelf ? "itself" : sessions[1].name}`),
    facts([
      ["query", times[0]],
      ["target", times[1]],
      ["probability", probabilityText(rows.probability[k])],
      ["apart", lengthText(Math.hypot(x, y, z))],
      ["query from target: ahead, left, up", [x, y, z].map((m) => `${m.toFixed(2)} m`).join(", ")],
      ["yaw", degreesText(yaw)],
    ]),
    k in rows.refused ? el("p", { class: "warn" }, `The optimised poses do not rest on it: ${rows.refused[k]}`) : null,
    ...pictures(k),
    el("h3", {}, "Position and its uncertainty"),
    ellipse(k, sigma),
    facts([
      ["1 sigma: ahead, left, up", [0, 1, 2].map((i) => lengthText(sigma[i])).join(", ")],
      ["1 sigma of yaw", `${((sigma[5] * 180) / Math.PI).toFixed(2)}°`],
      ["aligned voxels", rows.inliers[k].toLocaleString("en")],
      ["overlap (tau)", rows.overlap[k].toFixed(2)],
      ["matching words", rows.words[k].toLocaleString("en")],
      ["off in this picture", lengthText(rows.offset[k]), "Distance between the query's place in the picture and the place where this closure puts it"],
    ]),
  ];
  if (Number.isFinite(features[0])) {
    out.push(el("h3", {}, "Evidence"), featureTable(features), el("h3", {}, "Votes of neighbouring queries"), voteTable(votes, factors));
  }
  const command = `semloc show -w ${data.workspace} --closure ${k + 1} -o closure.png`;
  out.push(steps(), el("p", { class: "caption" }, "In full: ", el("code", {}, command)));
  return out.filter(Boolean);
}

function rejectedDetails(k) {
  const rows = data.rejected;
  const { sessions, times, isSelf } = endsOf(rows, k);
  const isPlace = Boolean(rows.at_query[k]);
  const title = isPlace ? `No closure: ${sessions[0].name}, ${times[0]}` : `${sessions[0].name} in ${isSelf ? "itself" : sessions[1].name}: best rejected`;
  const from = data.features.length * k;
  return [
    el("h3", {}, title),
    el("p", {}, isPlace ? "The best hypothesis was rejected: " : "", el("b", {}, reasonText(rows, k))),
    facts([
      ["query", times[0]],
      ["hypothesis in", `${sessions[1].name}, ${times[1]}`],
      ["probability", probabilityText(rows.probability[k])],
      ["1 sigma of the position", lengthText(rows.sigma[k])],
      ["aligned voxels", rows.inliers[k].toLocaleString("en")],
      ["overlap (tau)", rows.overlap[k].toFixed(2)],
      ["matching words", rows.words[k].toLocaleString("en")],
    ]),
    el("h3", {}, "Evidence"),
    featureTable(rows.evidence.slice(from, from + data.features.length)),
    steps(),
  ];
}

// -- evidence

const SHARES = new Set(["structure", "coverage", "contradiction", "fit"]);

function featureTable(values) {
  return facts(data.features.map((name, i) => {
    const value = values[i];
    const isShare = SHARES.has(name);
    const share = Math.min(1, Math.max(0, value));
    const bar = el("span", { class: "bar", "aria-hidden": "true" }, el("span"));
    bar.firstChild.style.width = `${(100 * share).toFixed(0)}%`;
    const text = isShare ? `${(100 * value).toFixed(0)} %` : value.toFixed(2);
    return [name, el("span", {}, isShare ? bar : null, Number.isFinite(value) ? text : "-"), data.meanings[name]];
  }));
}

function voteTable(votes, factors) {
  const value = Object.fromEntries(data.votes.map((name, i) => [name, votes[i]]));
  const [place, position, mode] = factors;
  return facts([
    ["probability of this query alone", probabilityText(value.own_probability), data.meanings.own_probability],
    ["neighbours with an answer", value.neighbours.toFixed(0), data.meanings.neighbours],
    ["support / conflict, near", `${value.support.toFixed(1)} / ${value.conflict.toFixed(1)}`, data.meanings.support],
    ["support / conflict, far", `${value.far_support.toFixed(1)} / ${value.far_conflict.toFixed(1)}`, data.meanings.far_support],
    ["ambiguity of the place", value.ambiguity.toFixed(2), data.meanings.ambiguity],
    ["probability of the place", probabilityText(place)],
    ["x confidence in the position", probabilityText(position)],
    ["x share of this pose", probabilityText(mode)],
  ]);
}

/** The ellipse of x and y in the target's axes, ahead is up. */
function ellipse(k, sigma) {
  const [xx, xy, yy] = data.closures.ellipse.slice(3 * k, 3 * k + 3);
  const middle = (xx + yy) / 2;
  const off = Math.hypot((xx - yy) / 2, xy);
  const long = SIGMAS * Math.sqrt(Math.max(middle + off, 1e-12));
  const short = SIGMAS * Math.sqrt(Math.max(middle - off, 1e-12));
  const angle = 0.5 * Math.atan2(2 * xy, xx - yy); // of the long axis from ahead to the left
  const pixels = 38 / long;
  const power = 10 ** Math.floor(Math.log10((long * 1.6)));
  const length = [5, 2, 1].map((m) => m * power).find((m) => m <= long * 1.6);
  const text = `Ellipse of ${SIGMAS} sigma: half axes ${lengthText(long)} and ${lengthText(short)}; 1 sigma up ${lengthText(sigma[2])}.`;
  const half = (length * pixels) / 2;
  return svg("svg", { viewBox: "0 0 200 112", width: 200, height: 112, role: "img", "aria-label": text },
    svg("path", { d: "M100 50 V6 M100 6 l-4 7 M100 6 l4 7", stroke: "var(--soft)", fill: "none" }),
    svg("text", { x: 107, y: 12, "font-size": 11, fill: "var(--soft)" }, "ahead"),
    svg("ellipse", { cx: 100, cy: 50, rx: long * pixels, ry: Math.max(1, short * pixels), transform: `rotate(${-90 - (angle * 180) / Math.PI} 100 50)`, fill: "var(--accent)", "fill-opacity": 0.25, stroke: "var(--accent)" }),
    svg("path", { d: `M${100 - half} 96 H${100 + half}`, stroke: "var(--ink)", "stroke-width": 2 }),
    svg("text", { x: 100, y: 109, "font-size": 11, "text-anchor": "middle", fill: "var(--ink)" }, `${lengthText(length)}, ${SIGMAS} sigma`));
}

// -- pictures

/** The query on the target before and after the alignment: voxels, or else the maps from above. */
function pictures(k) {
  const before = pictureOf(`before-${k}`, "Voxels of the query on the map of the target before the alignment");
  const after = pictureOf(`after-${k}`, "Voxels of the query on the map of the target as aligned");
  if (before && after) {
    return [el("div", { class: "pair" }, captioned(before, "before"), captioned(after, "aligned")),
      el("p", { class: "caption" }, "Voxels of the query in the colours of their classes on the pale map of the target, from above; x to the right, y up.")];
  }
  const { numbers } = endsOf(data.closures, k);
  if (!numbers.every((s) => data.sessions[s].sheet)) return [];
  const frames = overlayPoses(k);
  const [first, second] = [frames.before, frames.after].map((pose) => overlay(k, pose));
  return [el("div", { class: "pair" }, captioned(first, "before"), captioned(second, "aligned")),
    el("p", { class: "caption" }, "Maps from above: the query's in orange, the target's in blue, with the two places.")];
}

const captioned = (picture, text) => el("div", {}, picture, el("div", { class: "caption" }, text));

const compose = (a, b) => ({
  x: a.x + Math.cos(a.yaw) * b.x - Math.sin(a.yaw) * b.y,
  y: a.y + Math.sin(a.yaw) * b.x + Math.cos(a.yaw) * b.y,
  yaw: a.yaw + b.yaw,
});
const invert = (a) => ({
  x: -Math.cos(a.yaw) * a.x - Math.sin(a.yaw) * a.y,
  y: Math.sin(a.yaw) * a.x - Math.cos(a.yaw) * a.y,
  yaw: -a.yaw,
});
const planar = (array, k) => ({ x: array[3 * k], y: array[3 * k + 1], yaw: array[3 * k + 2] });

/** target_T_query before and after the alignment. */
function overlayPoses(k) {
  const after = planar(data.closures.pose, k);
  const { isSelf } = endsOf(data.closures, k);
  const own = data.closures.own;
  const before = isSelf ? compose(invert(planar(own, 2 * k + 1)), planar(own, 2 * k)) : { x: 0, y: 0, yaw: 0 };
  return { before, after };
}

function overlay(k, target_T_query) {
  const canvas = el("canvas", { width: PICTURE, height: PICTURE, role: "img", "aria-label": "The map of the query laid on the map of the target" });
  const { numbers, sessions } = endsOf(data.closures, k);
  const reach = REACH * (sessions[1].voxel_size || 0.3);
  const scale = PICTURE / (2 * reach);
  const heading = data.closures.heading[2 * k + 1];
  const turn = { x: 0, y: 0, yaw: Number.isFinite(heading) ? heading : 0 };
  const own = data.closures.own;
  const target = compose(turn, invert(planar(own, 2 * k + 1)));
  const query = compose(compose(turn, target_T_query), invert(planar(own, 2 * k)));
  const paint = () => {
    const c = canvas.getContext("2d");
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.fillStyle = "#ffffff";
    c.fillRect(0, 0, PICTURE, PICTURE);
    for (const [s, pose, tint] of [[numbers[1], target, TINTS.target], [numbers[0], query, TINTS.query]]) {
      const bitmap = sheetOf(s, paint);
      if (bitmap) c.drawImage(tinted(s, pose, tint, bitmap, scale), 0, 0);
    }
    const at = compose(turn, target_T_query);
    mark(c, 0, 0, turn.yaw, scale, "#145ac8");
    mark(c, at.x, at.y, at.yaw, scale, "#b85c00");
  };
  paint();
  return canvas;
}

function tinted(s, pose, tint, bitmap, scale) {
  const canvas = el("canvas", { width: PICTURE, height: PICTURE });
  const c = canvas.getContext("2d");
  c.setTransform(scale, 0, 0, -scale, PICTURE / 2, PICTURE / 2);
  c.globalAlpha = 0.8;
  drawSheet(c, s, pose, bitmap);
  c.setTransform(1, 0, 0, 1, 0, 0);
  c.globalAlpha = 1;
  c.globalCompositeOperation = "source-atop";
  c.fillStyle = tint;
  c.fillRect(0, 0, PICTURE, PICTURE);
  return canvas;
}

/** A dot and an arrow that shows where a vehicle looks. */
function mark(c, x, y, yaw, scale, colour) {
  const px = PICTURE / 2 + x * scale;
  const py = PICTURE / 2 - y * scale;
  c.strokeStyle = "#ffffff";
  c.fillStyle = colour;
  c.lineWidth = 2;
  c.save();
  c.translate(px, py);
  c.rotate(-yaw);
  c.beginPath();
  c.moveTo(16, 0);
  c.lineTo(-8, 8);
  c.lineTo(-4, 0);
  c.lineTo(-8, -8);
  c.closePath();
  c.fill();
  c.stroke();
  c.restore();
}
