// The data of the page: typed arrays, the groups of columns, and texts for people.

const TYPES = { f4: Float32Array, u2: Uint16Array, i4: Int32Array, u1: Uint8Array };

function bytesOf(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
  return bytes;
}

function unpack([type, base64]) {
  return new TYPES[type](bytesOf(base64).buffer);
}

function unpackAll(table) {
  const out = {};
  for (const [name, value] of Object.entries(table)) {
    const isPacked = Array.isArray(value) && value.length === 2 && value[0] in TYPES;
    out[name] = isPacked ? unpack(value) : value;
  }
  return out;
}

function readData() {
  const data = JSON.parse(document.getElementById("data").textContent);
  data.closures = unpackAll(data.closures);
  data.rejected = unpackAll(data.rejected);
  for (const session of data.sessions) {
    session.drive = unpackAll(session.drive);
    session.start = Number(BigInt(session.start_ns) / 1000n) / 1e6;
    session.isDated = session.start > 1e8; // later than 1973: not seconds since the start
  }
  data.groupOf = data.sessions.map(() => -1);
  data.groups.forEach((group, k) => group.forEach((s) => { data.groupOf[s] = k; }));
  return data;
}

// -- texts

const pad = (n, width = 2) => String(n).padStart(width, "0");

/** "2026-11-30 11:34:47.1", UTC; seconds where the log has no dates. */
function timeText(session, seconds, { date = true } = {}) {
  const at = session.start + seconds;
  if (!session.isDated) return `${at.toFixed(1)} s`;
  const tenths = Math.floor(at * 10 + 0.5);
  const day = new Date(tenths * 100);
  const clock = `${pad(day.getUTCHours())}:${pad(day.getUTCMinutes())}:${pad(day.getUTCSeconds())}.${((tenths % 10) + 10) % 10}`;
  return date ? `${dayText(session, seconds)} ${clock}` : clock;
}

function dayText(session, seconds = 0) {
  if (!session.isDated) return "";
  const day = new Date((session.start + seconds) * 1000);
  return `${day.getUTCFullYear()}-${pad(day.getUTCMonth() + 1)}-${pad(day.getUTCDate())}`;
}

function durationText(seconds) {
  if (!(seconds >= 0)) return "-";
  if (seconds < 120) return `${seconds.toFixed(1)} s`;
  const minutes = Math.floor(seconds / 60);
  if (minutes < 120) return `${minutes} min ${pad(Math.round(seconds % 60))} s`;
  return `${Math.floor(minutes / 60)} h ${pad(minutes % 60)} min`;
}

function lengthText(metres) {
  if (!Number.isFinite(metres)) return "-";
  if (metres >= 1000) return `${(metres / 1000).toFixed(metres >= 1e5 ? 0 : 1)} km`;
  if (metres >= 10) return `${metres.toFixed(0)} m`;
  return metres >= 1 ? `${metres.toFixed(2)} m` : `${(100 * metres).toFixed(1)} cm`;
}

function plural(count, noun) {
  return `${count.toLocaleString("en")} ${noun}${count === 1 ? "" : "s"}`;
}

/** Close to 1 more digits are shown: 0.9993. */
function probabilityText(p) {
  if (!Number.isFinite(p)) return "-";
  if (p >= 0.99995) return "> 0.9999";
  if (p > 0 && p < 0.0005) return "< 0.001";
  return p.toFixed(p > 0.99 ? 4 : 3);
}

function degreesText(radians) {
  const turned = ((((radians * 180) / Math.PI + 180) % 360) + 360) % 360 - 180;
  return `${turned.toFixed(1)}°`;
}

/** The reason of rejection `k`, with its figures. */
function reasonText(rejected, k) {
  let figure = rejected.first_figure[k];
  return rejected.sentences[rejected.sentence[k]].replace(/\{(\d+)\}/g, (_, decimals) =>
    rejected.figures[figure++].toFixed(Number(decimals)));
}

function median(values) {
  const sorted = Float64Array.from(values).sort();
  return sorted.length ? sorted[sorted.length >> 1] : NaN;
}
