// Colours by theme, sessions and probability.

const SESSION_COLOURS = ["#0072b2", "#b85c00", "#00795a", "#a3418a", "#7a6a00", "#2f6f9f", "#8a2be2", "#a83232"];
const SESSION_COLOURS_DARK = ["#56b4e9", "#ffa94d", "#3ddbb0", "#f29bd4", "#e3d34b", "#9fc9ee", "#c9a2ff", "#ff8a80"];
const STEPS = 24; // colours between the least and the greatest probability

function isDark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
}

function css(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/** Few sessions have fixed colours; of many each has a hue far from the one before. */
function sessionColour(s) {
  const fixed = isDark() ? SESSION_COLOURS_DARK : SESSION_COLOURS;
  if (data.sessions.length <= fixed.length) return fixed[s];
  return `hsl(${Math.round(s * 137.508) % 360} ${isDark() ? "70% 70%" : "65% 36%"})`;
}

/** Where a probability is on the ramp, in [0, 1]: by the odds of an error, as 0.9, 0.99, 0.999. */
function shareOfRamp(p) {
  const error = (q) => -Math.log10(Math.max(1 - q, 1e-5));
  const { least, greatest } = data.range;
  const span = error(greatest) - error(least);
  return span > 1e-9 ? Math.min(1, Math.max(0, (error(p) - error(least)) / span)) : 1;
}

function rampColours() {
  const ends = ["--low", "--middle", "--high"].map((name) => css(name).split(/\s+/).map(Number));
  return Array.from({ length: STEPS }, (_, k) => {
    const share = (2 * k) / (STEPS - 1);
    const a = ends[share < 1 ? 0 : 1];
    const b = ends[share < 1 ? 1 : 2];
    const w = share < 1 ? share : share - 1;
    return `rgb(${a.map((x, i) => Math.round(x + w * (b[i] - x))).join(" ")})`;
  });
}

const stepOf = (p) => Math.min(STEPS - 1, Math.floor(shareOfRamp(p) * STEPS));
