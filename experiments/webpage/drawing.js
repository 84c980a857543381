// Elements, scales and axes. Names reach the page as text alone, never as markup.

const SVG = "http://www.w3.org/2000/svg";
const DASHES = ["", "7 3", "2 3"];
const COLORS = 9;

function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

function shape(parent, name, attributes = {}, text = null) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== null) made.textContent = text;
  if (parent) parent.append(made);
  return made;
}

// A picture with its text alternative.
function picture(width, height, words) {
  const svg = shape(null, "svg", {
    viewBox: `0 0 ${width} ${height}`, width, height, role: "img", "aria-label": words,
  });
  shape(svg, "title", {}, words);
  return svg;
}

function color(number) {
  return `var(--c${number % COLORS})`;
}

function dash(number) {
  return DASHES[Math.floor(number / COLORS) % DASHES.length];
}

// From values to pixels; an axis is {log, from, to, zero}.
function scale(axis, values, start, end) {
  let numbers = values.filter((v) => v !== null && (!axis.log || v > 0));
  if (axis.zero) numbers = [...numbers, 0];
  let low = axis.from ?? numbers.reduce((a, b) => Math.min(a, b), Infinity);
  let high = axis.to ?? numbers.reduce((a, b) => Math.max(a, b), -Infinity);
  if (!Number.isFinite(low)) low = axis.log ? 1 : 0;
  if (!Number.isFinite(high) || high <= low) high = axis.log ? low * 10 : low + 1;
  if (!axis.log) {
    const room = 0.04 * (high - low);
    low -= axis.from === undefined ? room : 0;
    high += axis.to === undefined ? room : 0;
  }
  const turn = axis.log ? Math.log10 : (v) => v;
  const [a, b] = [turn(low), turn(high)];
  const at = (v) => start + ((turn(Math.max(v, axis.log ? low : -Infinity)) - a) / (b - a)) * (end - start);
  return { at, low, high, log: Boolean(axis.log) };
}

function ticks(scaled, count) {
  const { low, high, log } = scaled;
  if (log) {
    const found = [];
    const decades = Math.log10(high / low);
    const steps = decades > count / 2 ? [1] : decades > 1 ? [1, 3] : [1, 2, 3, 5, 7];
    for (let k = Math.floor(Math.log10(low)); k <= Math.ceil(Math.log10(high)); k += 1) {
      for (const m of steps) found.push(Number(`${m}e${k}`));
    }
    return found.filter((v) => v >= low * 0.999 && v <= high * 1.001);
  }
  const rough = (high - low) / count;
  const ten = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((m) => m * ten).find((s) => s >= rough);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) {
    found.push(Number((k * step).toPrecision(12)));
  }
  return found;
}

function shown(value) {
  const size = Math.abs(value);
  if (size >= 1e6) return `${Number((value / 1e6).toPrecision(3))}M`;
  if (size >= 1e4) return `${Number((value / 1e3).toPrecision(3))}k`;
  return String(Number(value.toPrecision(3)));
}

function gridlines(svg, scaled, values, from, to, vertical, labels) {
  for (const value of values) {
    const at = scaled.at(value);
    const ends = vertical ? { x1: at, x2: at, y1: from, y2: to } : { x1: from, x2: to, y1: at, y2: at };
    shape(svg, "line", { ...ends, stroke: "var(--grid)" });
    if (!labels) continue;
    const place = vertical
      ? { x: at, y: to + 16, "text-anchor": "middle" }
      : { x: from - 6, y: at + 4, "text-anchor": "end" };
    shape(svg, "text", { ...place, class: "quiet" }, labels(value));
  }
}

// The d of a path through points; a gap where there is no number.
function path(xs, ys) {
  let d = "";
  let pen = "M";
  for (let i = 0; i < xs.length; i += 1) {
    if (xs[i] === null || ys[i] === null || Number.isNaN(ys[i]) || Number.isNaN(xs[i])) {
      pen = "M";
    } else {
      d += `${pen}${xs[i].toFixed(1)} ${ys[i].toFixed(1)}`;
      pen = "L";
    }
  }
  return d;
}

function selector(label, names, change) {
  const select = element("select", {}, ...names.map((name, i) => element("option", { value: i }, name)));
  select.addEventListener("change", () => change(Number(select.value)));
  return { label: element("label", {}, label, select), select };
}
