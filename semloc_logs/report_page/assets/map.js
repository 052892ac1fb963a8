// The map: sheets, drives, closures and places without one, on a canvas with zoom and pan.

const PICK = 9; // pixels around the pointer
const MOST_ZOOM = 400; // pixels a metre
const FIT = 0.92; // share of the canvas that everything fills
const MANY_CLOSURES = 1500; // on the map, from which on they are drawn finer from far away
const SLOW = 14; // ms of a painting, from which on the last one is moved while the view moves
const REST = 130; // ms without movement after which it is painted again
const PLACES_FROM = 3; // pixels between places, from which on they are drawn

class MapView {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.x = 0; // metres at the middle
    this.y = 0;
    this.scale = 1; // pixels a metre
    this.pointers = new Map();
    this.isFitted = true;
    this.paths = data.sessions.map((session, s) => this.pathOf(session, s));
    this.bounds = this.boundsOf();
    this.frames = 0;
    this.listen();
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  // -- geometry

  pathOf(session) {
    const { xy, is_line: isLine } = session.drive;
    const path = new Path2D();
    for (let k = 0; k < xy.length; k += 2) {
      if (k === 0 || !isLine) path.moveTo(xy[k], xy[k + 1]);
      else path.lineTo(xy[k], xy[k + 1]);
    }
    return path;
  }

  boundsOf() {
    let [x0, y0, x1, y1] = [Infinity, Infinity, -Infinity, -Infinity];
    const take = (xy) => {
      for (let k = 0; k < xy.length; k += 2) {
        if (!Number.isFinite(xy[k])) continue;
        x0 = Math.min(x0, xy[k]);
        x1 = Math.max(x1, xy[k]);
        y0 = Math.min(y0, xy[k + 1]);
        y1 = Math.max(y1, xy[k + 1]);
      }
    };
    data.sessions.forEach((session) => take(session.drive.xy));
    take(data.closures.xy);
    if (!(x1 >= x0)) return { x0: -10, y0: -10, x1: 10, y1: 10 };
    const border = Math.max(8, 0.02 * Math.max(x1 - x0, y1 - y0));
    return { x0: x0 - border, y0: y0 - border, x1: x1 + border, y1: y1 + border };
  }

  /** Metres by which a session is moved where sessions are drawn apart from each other. */
  offset(s) {
    if (!state.spread) return [0, 0];
    const n = Math.max(1, data.sessions.length - 1);
    const { y0, y1, x0, x1 } = this.bounds;
    const reach = state.spread * Math.max(y1 - y0, 0.4 * (x1 - x0)) * Math.min(6, Math.sqrt(n));
    return [(0.25 * reach * s) / n, (-reach * s) / n];
  }

  /** The canvas's x and y (pixels) of a place (metres). */
  pixel(x, y) {
    return [this.width / 2 + (x - this.x) * this.scale, this.height / 2 - (y - this.y) * this.scale];
  }

  place(px, py) {
    return [this.x + (px - this.width / 2) / this.scale, this.y - (py - this.height / 2) / this.scale];
  }

  /** The two ends of row `k` of closures or rejected hypotheses, metres, NaN where unknown. */
  ends(rows, k) {
    const a = this.offset(rows.sessions[2 * k]);
    const b = this.offset(rows.sessions[2 * k + 1]);
    const xy = rows.xy;
    return [xy[4 * k] + a[0], xy[4 * k + 1] + a[1], xy[4 * k + 2] + b[0], xy[4 * k + 3] + b[1]];
  }

  // -- view

  resize() {
    const ratio = devicePixelRatio || 1;
    this.width = this.canvas.clientWidth;
    this.height = this.canvas.clientHeight;
    this.canvas.width = Math.max(1, Math.round(this.width * ratio));
    this.canvas.height = Math.max(1, Math.round(this.height * ratio));
    if (this.isFitted) this.fit();
    else this.draw();
  }

  fit(bounds = this.bounds) {
    const far = this.offset(data.sessions.length - 1);
    const x0 = bounds.x0 + Math.min(0, far[0]);
    const x1 = bounds.x1 + Math.max(0, far[0]);
    const y0 = bounds.y0 + Math.min(0, far[1]);
    this.x = (x0 + x1) / 2;
    this.y = (y0 + bounds.y1) / 2;
    this.scale = FIT * Math.min(this.width / (x1 - x0), this.height / (bounds.y1 - y0));
    this.isFitted = bounds === this.bounds;
    this.draw();
  }

  zoom(factor, px = this.width / 2, py = this.height / 2) {
    const [x, y] = this.place(px, py);
    const { x0, x1, y0, y1 } = this.bounds;
    const least = (0.2 * Math.min(this.width, this.height)) / Math.max(x1 - x0, y1 - y0);
    this.scale = Math.min(MOST_ZOOM, Math.max(Math.min(least, this.scale), this.scale * factor));
    this.x = x - (px - this.width / 2) / this.scale;
    this.y = y + (py - this.height / 2) / this.scale;
    this.isFitted = false;
    this.draw(true);
  }

  pan(dx, dy) {
    this.x -= dx / this.scale;
    this.y += dy / this.scale;
    this.isFitted = false;
    this.draw(true);
  }

  /** Bring row `k` into view, closer if its ends could not be told apart. */
  show(rows, k) {
    const [ax, ay, bx, by] = this.ends(rows, k);
    const isQuery = Number.isFinite(ax);
    const x = isQuery ? ax : bx;
    const y = isQuery ? ay : by;
    if (!Number.isFinite(x)) return;
    const [px, py] = this.pixel(x, y);
    const border = 40;
    const isInside = px > border && py > border && px < this.width - border && py < this.height - border;
    const close = Math.min(this.width, this.height) / 120; // 120 m across
    if (isInside && this.scale >= close / 2) return this.draw();
    this.x = x;
    this.y = y;
    this.scale = Math.max(this.scale, close);
    this.isFitted = false;
    return this.draw();
  }

  // -- drawing

  draw(isMoving = false) {
    this.isMoving = isMoving && (this.isMoving || !this.frames);
    if (this.frames) return;
    this.frames = requestAnimationFrame(() => {
      this.frames = 0;
      if (this.isMoving && this.last && this.paintMs > SLOW) this.paintMoved();
      else this.paint();
      this.isMoving = false;
    });
  }

  /** The last painting as seen from here; it is painted anew when the view rests. */
  paintMoved() {
    const c = this.context;
    const ratio = devicePixelRatio || 1;
    const zoom = this.scale / this.last.scale;
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.fillStyle = this.last.background;
    c.fillRect(0, 0, this.width, this.height);
    const dx = this.width / 2 + (this.last.x - this.x) * this.scale - (zoom * this.width) / 2;
    const dy = this.height / 2 - (this.last.y - this.y) * this.scale - (zoom * this.height) / 2;
    c.drawImage(this.copy, dx, dy, zoom * this.width, zoom * this.height);
    clearTimeout(this.rest);
    this.rest = setTimeout(() => this.draw(), REST);
  }

  keep() {
    this.copy = this.copy || document.createElement("canvas");
    if (this.copy.width !== this.canvas.width || this.copy.height !== this.canvas.height) {
      this.copy.width = this.canvas.width;
      this.copy.height = this.canvas.height;
    }
    this.copy.getContext("2d").drawImage(this.canvas, 0, 0);
    this.last = { x: this.x, y: this.y, scale: this.scale, background: css("--panel") };
  }

  paint() {
    clearTimeout(this.rest);
    const began = performance.now();
    const ratio = devicePixelRatio || 1;
    const c = this.context;
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.fillStyle = css("--panel");
    c.fillRect(0, 0, this.width, this.height);
    this.world = [ratio * this.scale, 0, 0, -ratio * this.scale,
      ratio * (this.width / 2 - this.x * this.scale), ratio * (this.height / 2 + this.y * this.scale)];
    if (state.layers.maps) this.paintSheets();
    if (state.layers.drives) this.paintDrives();
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    if (state.layers.places) this.paintPlaces();
    if (state.layers.closures) this.paintClosures();
    this.paintSelected();
    this.paintScale();
    this.paintGroups();
    this.keep();
    this.paintMs = performance.now() - began;
    this.canvas.dataset.paintMs = this.paintMs.toFixed(1);
  }

  worldFor(s) {
    const [dx, dy] = this.offset(s);
    const [a, b, c, d, e, f] = this.world;
    this.context.setTransform(a, b, c, d, e + a * dx, f + d * dy);
  }

  paintSheets() {
    const c = this.context;
    c.globalAlpha = isDark() ? 0.62 : 0.8;
    data.sessions.forEach((session, s) => {
      const sheet = session.sheet;
      if (!sheet || !isSessionShown(s) || !this.isInView(session, s)) return;
      const bitmap = sheetOf(s, () => this.draw());
      if (!bitmap) return;
      this.worldFor(s);
      const pose = { x: session.place[0], y: session.place[1], yaw: session.place[2] };
      drawSheet(c, s, pose, bitmap);
    });
    c.globalAlpha = 1;
  }

  isInView(session, s) {
    const [dx, dy] = this.offset(s);
    const reach = Math.hypot(session.sheet.width, session.sheet.height);
    const [cos, sin] = [Math.cos(session.place[2]), Math.sin(session.place[2])];
    const mx = session.sheet.left + session.sheet.width / 2;
    const my = session.sheet.upper - session.sheet.height / 2;
    const [px, py] = this.pixel(session.place[0] + cos * mx - sin * my + dx, session.place[1] + sin * mx + cos * my + dy);
    const r = (reach / 2) * this.scale;
    return px + r > 0 && py + r > 0 && px - r < this.width && py - r < this.height;
  }

  paintDrives() {
    const c = this.context;
    const width = data.sessions.length > 20 ? 1.3 : 2.2;
    data.sessions.forEach((session, s) => {
      if (!session.drive.is_line) return;
      this.worldFor(s);
      c.lineJoin = "round";
      c.globalAlpha = isSessionShown(s) ? 1 : 0.18;
      c.strokeStyle = css("--page");
      c.lineWidth = (width + 2) / this.scale;
      if (data.sessions.length <= 20) c.stroke(this.paths[s]);
      c.strokeStyle = sessionColour(s);
      c.lineWidth = width / this.scale;
      c.stroke(this.paths[s]);
    });
    c.globalAlpha = 1;
  }

  paintPlaces() {
    const rows = data.rejected;
    if (this.scale * data.spacing < PLACES_FROM && rows.count > 400) return;
    const c = this.context;
    c.strokeStyle = css("--place");
    c.fillStyle = css("--page");
    c.lineWidth = 1.4;
    c.beginPath();
    for (let k = 0; k < rows.count; k++) {
      if (!rows.at_query[k] || !isSessionShown(rows.sessions[2 * k])) continue;
      const [x, y] = this.ends(rows, k);
      const [px, py] = this.pixel(x, y);
      if (!(px > -5 && py > -5 && px < this.width + 5 && py < this.height + 5)) continue;
      c.moveTo(px + 3.2, py);
      c.arc(px, py, 3.2, 0, 2 * Math.PI);
    }
    c.fill();
    c.stroke();
  }

  paintClosures() {
    const c = this.context;
    const rows = data.closures;
    const byStep = Array.from({ length: STEPS }, () => []);
    for (const k of state.shown) byStep[stepOf(rows.probability[k])].push(k);
    const isDense = state.shown.length > MANY_CLOSURES && this.scale < 3;
    const radius = isDense ? 1.1 : 2.8;
    c.globalAlpha = isDense ? 0.55 : 1;
    const offsets = data.sessions.map((_, s) => this.offset(s));
    const left = this.width / 2 - this.x * this.scale;
    const top = this.height / 2 + this.y * this.scale;
    const xy = rows.xy;
    // the least probable last, so that they are seen
    [...rampColours().entries()].reverse().forEach(([step, colour]) => {
      const some = byStep[step];
      if (!some.length) return;
      c.strokeStyle = colour;
      c.fillStyle = colour;
      c.lineWidth = isDense ? 0.7 : 1.6;
      c.beginPath();
      for (const k of some) {
        const a = offsets[rows.sessions[2 * k]];
        const b = offsets[rows.sessions[2 * k + 1]];
        const ax = left + (xy[4 * k] + a[0]) * this.scale;
        const ay = top - (xy[4 * k + 1] + a[1]) * this.scale;
        const bx = left + (xy[4 * k + 2] + b[0]) * this.scale;
        const by = top - (xy[4 * k + 3] + b[1]) * this.scale;
        if (Math.max(ax, bx) < 0 || Math.min(ax, bx) > this.width || Math.max(ay, by) < 0 || Math.min(ay, by) > this.height) continue;
        c.moveTo(ax, ay);
        c.lineTo(bx, by);
        c.rect(ax - radius, ay - radius, 2 * radius, 2 * radius);
      }
      c.stroke();
      c.fill();
    });
    c.globalAlpha = 1;
  }

  paintSelected() {
    if (!state.selected) return;
    const rows = rowsOf(state.selected);
    const c = this.context;
    const [ax, ay, bx, by] = this.ends(rows, state.selected.index);
    const isClosure = state.selected.kind === "closure";
    const ends = [[ax, ay], [bx, by]].map(([x, y]) => this.pixel(x, y));
    const isLine = ends.every(([x, y]) => Number.isFinite(x) && Number.isFinite(y));
    for (const [colour, width] of [[css("--page"), 6], [css("--mark"), 2.6]]) {
      c.strokeStyle = colour;
      c.lineWidth = width;
      c.setLineDash(isClosure ? [] : [7, 5]);
      if (isLine) {
        c.beginPath();
        c.moveTo(...ends[0]);
        c.lineTo(...ends[1]);
        c.stroke();
      }
      c.setLineDash([]);
      ends.forEach(([x, y], end) => {
        c.beginPath();
        c.arc(x, y, end ? 6 : 9, 0, 2 * Math.PI);
        c.stroke();
      });
    }
  }

  paintScale() {
    const c = this.context;
    const most = 120 / this.scale;
    const power = 10 ** Math.floor(Math.log10(most));
    const length = [5, 2, 1].map((m) => m * power).find((m) => m <= most);
    const width = length * this.scale;
    const [x, y] = [14, this.height - 16];
    c.font = "12px system-ui, sans-serif";
    c.lineWidth = 4;
    c.strokeStyle = css("--page");
    c.fillStyle = css("--ink");
    const text = length >= 1000 ? `${length / 1000} km` : length >= 1 ? `${length} m` : `${Math.round(100 * length)} cm`;
    c.strokeText(text, x, y - 7);
    c.fillText(text, x, y - 7);
    c.fillRect(x, y, width, 3);
    c.fillRect(x, y - 4, 1.5, 7);
    c.fillRect(x + width - 1.5, y - 4, 1.5, 7);
  }

  /** Names of the groups, where there are several. */
  paintGroups() {
    if (data.groups.length < 2 || state.spread) return;
    const c = this.context;
    c.font = "12px system-ui, sans-serif";
    c.lineWidth = 4;
    data.groups.forEach((group, g) => {
      const { x0, y1 } = data.groupBounds[g];
      const [px, py] = this.pixel(x0, y1);
      const text = group.length === 1 ? data.sessions[group[0]].name : `group ${g + 1}: ${plural(group.length, "session")}`;
      c.strokeStyle = css("--panel");
      c.fillStyle = css("--soft");
      c.strokeText(text, px, py - 6);
      c.fillText(text, px, py - 6);
    });
  }

  // -- picking

  /** The closure or the place without closure at a pixel, or null. */
  pick(px, py) {
    let best = null;
    let nearest = PICK;
    if (state.layers.closures) {
      for (const k of state.shown) {
        const [ax, ay, bx, by] = this.ends(data.closures, k);
        const off = distanceToLine([px, py], this.pixel(ax, ay), this.pixel(bx, by));
        if (off < nearest) {
          nearest = off;
          best = { kind: "closure", index: k };
        }
      }
    }
    if (best && nearest < 5) return best;
    const rows = data.rejected;
    let place = null;
    for (let k = 0; k < rows.count; k++) {
      if (!rows.at_query[k] || !isSessionShown(rows.sessions[2 * k])) continue;
      const [x, y] = this.pixel(...this.ends(rows, k).slice(0, 2));
      const off = Math.hypot(x - px, y - py);
      if (off < nearest) {
        nearest = off;
        place = { kind: "rejected", index: k };
      }
    }
    return place || best;
  }

  // -- input

  listen() {
    const canvas = this.canvas;
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const lines = event.deltaMode === 1 ? 16 : 1;
      this.zoom(Math.exp(-event.deltaY * lines * 0.0016), event.offsetX, event.offsetY);
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, { x: event.offsetX, y: event.offsetY });
      this.moved = this.pointers.size > 1 ? Infinity : 0;
      byId("tip").hidden = true;
    });
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", (event) => this.release(event, true));
    canvas.addEventListener("pointercancel", (event) => this.release(event, false));
    canvas.addEventListener("pointerleave", () => { byId("tip").hidden = true; });
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  move(event) {
    const last = this.pointers.get(event.pointerId);
    const at = { x: event.offsetX, y: event.offsetY };
    if (!last) {
      this.hover(at);
      return;
    }
    const others = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, p]) => p);
    this.pointers.set(event.pointerId, at);
    if (others.length) {
      const before = Math.hypot(last.x - others[0].x, last.y - others[0].y);
      const after = Math.hypot(at.x - others[0].x, at.y - others[0].y);
      this.pan((at.x - last.x) / 2, (at.y - last.y) / 2);
      if (before > 5) this.zoom(after / before, (at.x + others[0].x) / 2, (at.y + others[0].y) / 2);
      return;
    }
    this.moved += Math.abs(at.x - last.x) + Math.abs(at.y - last.y);
    if (this.moved > 4) {
      this.canvas.classList.add("dragging");
      this.pan(at.x - last.x, at.y - last.y);
    }
  }

  release(event, isClick) {
    const wasDown = this.pointers.delete(event.pointerId);
    this.canvas.classList.remove("dragging");
    if (!isClick || !wasDown || this.moved > 4) return;
    const picked = this.pick(event.offsetX, event.offsetY);
    select(picked && picked.kind, picked && picked.index);
  }

  hover(at) {
    const picked = this.pick(at.x, at.y);
    this.canvas.classList.toggle("over", Boolean(picked));
    const tip = byId("tip");
    tip.hidden = !picked;
    if (!picked) return;
    tip.replaceChildren(...tipOf(picked));
    const isRight = at.x > this.width / 2;
    tip.style.left = isRight ? "auto" : `${at.x + 14}px`;
    tip.style.right = isRight ? `${this.width - at.x + 14}px` : "auto";
    tip.style.top = `${Math.max(4, at.y - 20)}px`;
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = event.shiftKey ? 200 : 60;
    const actions = {
      ArrowLeft: () => this.pan(step, 0),
      ArrowRight: () => this.pan(-step, 0),
      ArrowUp: () => this.pan(0, step),
      ArrowDown: () => this.pan(0, -step),
      "+": () => this.zoom(1.4),
      "=": () => this.zoom(1.4),
      "-": () => this.zoom(1 / 1.4),
      0: () => this.fit(),
      n: () => selectNext(1),
      p: () => selectNext(-1),
      Enter: () => state.selected && byId("details").focus(),
      Escape: () => select(null),
    };
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    event.preventDefault();
    action();
  }
}

const rowsOf = (selected) => (selected.kind === "closure" ? data.closures : data.rejected);

function distanceToLine([px, py], [ax, ay], [bx, by]) {
  const [dx, dy] = [bx - ax, by - ay];
  const long = dx * dx + dy * dy;
  const share = long > 0 ? Math.min(1, Math.max(0, ((px - ax) * dx + (py - ay) * dy) / long)) : 0;
  return Math.hypot(px - ax - share * dx, py - ay - share * dy);
}

/** Short lines about a closure or a place, under the pointer. */
function tipOf({ kind, index: k }) {
  const rows = kind === "closure" ? data.closures : data.rejected;
  const [query, target] = [0, 1].map((end) => data.sessions[rows.sessions[2 * k + end]]);
  const times = [0, 1].map((end) => timeText([query, target][end], rows.t[2 * k + end]));
  if (kind === "rejected") {
    return [el("div", {}, el("b", {}, query.name), ` ${times[0]}: no closure`), el("div", {}, reasonText(rows, k))];
  }
  const apart = Math.hypot(rows.pose[3 * k], rows.pose[3 * k + 1], rows.height[k]);
  return [
    el("div", {}, el("b", {}, query.name), ` ${times[0]}`),
    el("div", {}, "in ", el("b", {}, target.name), ` ${times[1]}`),
    el("div", {}, `probability ${probabilityText(rows.probability[k])}, ${lengthText(apart)} apart, yaw ${degreesText(rows.pose[3 * k + 2])}`),
  ];
}
