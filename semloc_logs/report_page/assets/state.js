// What is shown and selected; parts of the page listen to changes.

const state = {
  query: -1, // number of a session, or all
  target: -1,
  either: -1, // a session at either end
  low: 0, // probabilities from and to
  from: "",
  to: "",
  layers: { maps: true, drives: true, closures: true, places: true },
  spread: 0,
  selected: null, // {kind: "closure" | "rejected", index}
  shown: [], // numbers of the closures that pass the filters
};

const listeners = [];

function onChange(listener) {
  listeners.push(listener);
}

/** Change the state; listeners get the names of what changed. */
function change(values) {
  Object.assign(state, values);
  const names = new Set(Object.keys(values));
  const isFilter = ["query", "target", "either", "low", "from", "to"].some((n) => names.has(n));
  if (isFilter) {
    state.shown = filtered();
    names.add("shown");
  }
  for (const listener of listeners) listener(names);
}

function filtered() {
  const { sessions, probability, t, count } = data.closures;
  const out = [];
  for (let k = 0; k < count; k++) {
    const q = sessions[2 * k];
    const g = sessions[2 * k + 1];
    if (state.query >= 0 && q !== state.query) continue;
    if (state.target >= 0 && g !== state.target) continue;
    if (state.either >= 0 && q !== state.either && g !== state.either) continue;
    if (probability[k] < state.low) continue;
    if (state.from || state.to) {
      const day = dayText(data.sessions[q], t[2 * k]);
      if ((state.from && day < state.from) || (state.to && day > state.to)) continue;
    }
    out.push(k);
  }
  return out;
}

/** Whether a session is at an end that the filters leave. */
function isSessionShown(s) {
  if (state.query < 0 && state.target < 0 && state.either < 0) return true;
  if (s === state.query || s === state.target || s === state.either) return true;
  return state.partners.has(s);
}

onChange((names) => {
  if (!names.has("shown")) return;
  state.partners = new Set();
  for (const k of state.shown) {
    state.partners.add(data.closures.sessions[2 * k]);
    state.partners.add(data.closures.sessions[2 * k + 1]);
  }
});

function select(kind, index) {
  change({ selected: kind === null ? null : { kind, index } });
}

/** The closure `step` after the selected one among the shown ones. */
function selectNext(step) {
  if (!state.shown.length) return;
  const isClosure = state.selected && state.selected.kind === "closure";
  const at = isClosure ? state.shown.indexOf(state.selected.index) : -1;
  const n = state.shown.length;
  const next = at < 0 ? (step > 0 ? 0 : n - 1) : (at + step + n) % n;
  select("closure", state.shown[next]);
}
