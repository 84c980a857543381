// Functions for elements, scales and lines. Names reach the page only as text, never as markup.

function change(node, attributes) {
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  return node;
}

function element(name, attributes = {}, ...children) {
  const made = change(document.createElement(name), attributes);
  made.append(...children);
  return made;
}

function shape(parent, name, attributes = {}, text = "") {
  const made = change(document.createElementNS("http://www.w3.org/2000/svg", name), attributes);
  if (text) made.textContent = text;
  if (parent) parent.append(made);
  return made;
}

// Returns an empty picture; `words` is its text alternative.
function picture(width, height, words) {
  return shape(null, "svg", { viewBox: `0 0 ${width} ${height}`, width, height, role: "img", "aria-label": words });
}

// Returns a function that maps values from low to high to pixels from start to end, linearly or (if `log`) logarithmically. Values below low go to start.
function scale(low, high, start, end, log = false) {
  const turn = log ? Math.log10 : (v) => v;
  return (v) => start + ((turn(Math.max(v, low)) - turn(low)) / (turn(high) - turn(low))) * (end - start);
}

const pixels = (values, to) => values.map((v) => (v === null ? null : to(v)));

function ticks(low, high, count) {
  const rough = (high - low) / count;
  const step = [1, 2, 5, 10].map((m) => m * 10 ** Math.floor(Math.log10(rough))).find((s) => s >= rough);
  const first = Math.ceil(low / step - 1e-9);
  return Array.from({ length: Math.floor(high / step + 1e-9) - first + 1 }, (_, k) => (first + k) * step);
}

const largest = (values, least) => values.reduce((a, b) => Math.max(a, b ?? 0), least);

const shown = (value) => (Math.abs(value) >= 1e4 ? value.toExponential(1) : String(Number(value.toPrecision(3))));

// Returns the attribute d of a path through points, with a gap where a value is missing.
function path(xs, ys) {
  let d = "";
  xs.forEach((x, i) => {
    if (x !== null && ys[i] !== null) d += `${i && xs[i - 1] !== null && ys[i - 1] !== null ? "L" : "M"}${x.toFixed(1)} ${ys[i].toFixed(1)}`;
  });
  return d;
}
