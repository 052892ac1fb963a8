// Elements without markup in texts: names come from logs, so that all texts are text nodes.

function el(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === undefined || value === null || value === false) continue;
    if (name === "class") node.className = value;
    else if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value === true ? "" : String(value));
  }
  node.append(...children.flat().filter((c) => c !== null && c !== undefined && c !== false));
  return node;
}

function svg(tag, attributes = {}, ...children) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, String(value));
  node.append(...children);
  return node;
}

const byId = (id) => document.getElementById(id);

/** A table of rows of texts or nodes; columns are {title, number}. */
function table(columns, rows, attributes = {}) {
  const kind = (k) => (columns[k].number ? "number" : undefined);
  return el("table", attributes,
    el("thead", {}, el("tr", {}, columns.map((c, k) => el("th", { scope: "col", class: kind(k) }, c.title)))),
    el("tbody", {}, rows.map((row) => el("tr", {}, row.map((cell, k) => el("td", { class: kind(k) }, cell))))));
}

/** A table with a name at the left of each value. */
function facts(rows) {
  return el("table", { class: "facts" }, el("tbody", {}, rows.map(([name, value, title]) =>
    el("tr", {}, el("th", { scope: "row", title }, name), el("td", { class: "number" }, value)))));
}
