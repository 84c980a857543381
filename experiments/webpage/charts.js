// Pictures of data: lines, means with whiskers, and what is in stanford.js. Every picture is drawn anew for its width.

const redraws = [];
const DRAWN = { lines, whiskers, stanford };
let clips = 0; // names of clip paths

function chart(place, data) {
  let view = 0;
  const off = new Set();
  const controls = element("div", { class: "controls" });
  const holder = element("div");
  const legend = element("div", { class: "legend", role: "group", "aria-label": `${data.title}: lines` });
  if (data.views.length > 1) {
    const names = data.views.map((one) => one.name);
    controls.append(selector(data.title, names, (number) => { view = number; draw(); }).label);
  } else {
    controls.append(element("span", { class: "head" }, data.title));
  }
  place.append(controls, holder, legend);

  function draw() {
    const width = Math.max(280, place.clientWidth);
    if (!place.clientWidth) return; // in a hidden section
    holder.replaceChildren(DRAWN[data.kind](data.views[view], data.title, width, off));
    if (data.kind === "lines") labels();
  }

  function labels() {
    legend.replaceChildren(...data.views[view].lines.map((line, i) => {
      const button = element("button", { type: "button", "aria-pressed": String(!off.has(line.name)) });
      const sample = shape(null, "svg", { viewBox: "0 0 26 8", "aria-hidden": "true" });
      shape(sample, "path", { d: "M0 4L26 4", ...look(line, i) });
      button.append(sample, line.name);
      button.addEventListener("click", () => {
        if (!off.delete(line.name)) off.add(line.name);
        draw();
        legend.children[i].focus();
      });
      return button;
    }));
  }

  redraws.push(draw);
}

function look(line, number) {
  const hue = line.color ?? number;
  const stroke = line.reference ? "var(--ink)" : color(hue);
  const style = line.reference ? "1 3" : dash(hue);
  return { fill: "none", stroke, "stroke-width": line.reference ? 2.5 : 1.8, "stroke-dasharray": style };
}

function lines(view, title, width, off) {
  const height = 320;
  const frame = { left: 58, right: width - 14, top: 10, bottom: height - 46 };
  const seen = view.lines.map((line, i) => [line, i]).filter(([line]) => !off.has(line.name));
  const words = `${title}: ${view.name}. ${view.y.label} over ${view.x.label}; ` +
    `${seen.map(([line]) => line.name).join(", ")}.`;
  const svg = picture(width, height, words);
  const x = scale(view.x, view.lines.flatMap((line) => line.x), frame.left, frame.right);
  const heights = view.lines.flatMap((line) => [...line.y, ...(line.low ?? []), ...(line.high ?? [])]);
  const y = scale(view.y, heights, frame.bottom, frame.top);
  if (view.x.band) {
    const [a, b] = view.x.band.map(x.at);
    shape(svg, "rect", { x: a, y: frame.top, width: b - a, height: frame.bottom - frame.top, fill: "var(--band)", opacity: 0.6 });
    shape(svg, "text", { x: (a + b) / 2, y: frame.bottom - 6, "text-anchor": "middle", class: "quiet" }, "95 % interval");
  }
  const share = (v) => `${Math.round(100 * v)} %`;
  gridlines(svg, x, ticks(x, width / 80), frame.top, frame.bottom, true, shown);
  gridlines(svg, y, view.y.ticks ?? ticks(y, 6), frame.left, frame.right, false, view.y.to === 1 ? share : shown);
  for (const [axis, scaled] of [[view.x, x], [view.y, y]]) {
    if (axis.zero && !scaled.log) {
      const at = scaled.at(0);
      const ends = scaled === x ? { x1: at, x2: at, y1: frame.top, y2: frame.bottom } : { x1: frame.left, x2: frame.right, y1: at, y2: at };
      shape(svg, "line", { ...ends, stroke: "var(--ink)" });
    }
  }
  clips += 1;
  const clip = `clip-${clips}`;
  shape(svg, "clipPath", { id: clip }).append(shape(null, "rect", {
    x: frame.left, y: frame.top, width: frame.right - frame.left, height: frame.bottom - frame.top,
  }));
  const inside = shape(svg, "g", { "clip-path": `url(#${clip})` });
  for (const [line, i] of seen) {
    const xs = line.x.map((v) => (v === null || (x.log && v <= 0) ? null : x.at(v)));
    const at = (values) => values.map((v) => (v === null ? null : y.at(v)));
    if (line.low) {
      const there = xs.map((_, k) => k).filter((k) => line.low[k] !== null && line.high[k] !== null);
      const ring = [...there.map((k) => [xs[k], y.at(line.low[k])]), ...there.reverse().map((k) => [xs[k], y.at(line.high[k])])];
      shape(inside, "polygon", { points: ring.map((p) => p.map((v) => v.toFixed(1)).join(",")).join(" "), fill: color(line.color ?? i), opacity: 0.18 });
    }
    shape(inside, "path", { d: path(xs, at(line.y)), ...look(line, i) });
  }
  shape(svg, "text", { x: (frame.left + frame.right) / 2, y: height - 8, "text-anchor": "middle" }, view.x.label);
  const middle = (frame.top + frame.bottom) / 2;
  shape(svg, "text", { x: 13, y: middle, "text-anchor": "middle", transform: `rotate(-90 13 ${middle})` }, view.y.label);
  return svg;
}

function whiskers(view, title, width) {
  const narrow = width < 560;
  const row = narrow ? 38 : 22;
  const height = view.rows.length * row + 44;
  const left = narrow ? 12 : Math.min(0.4 * width, 20 + 7.2 * Math.max(...view.rows.map((one) => one[0].length)));
  const ordered = [...view.rows].sort((a, b) => b[1] - a[1]);
  const said = ordered.map(([name, mean, low, high]) =>
    `${name} ${shown(mean)}${low === null ? "" : ` (${shown(low)} to ${shown(high)})`}`);
  const svg = picture(width, height, `${title}: ${view.name}. ${said.join(", ")}.`);
  const ends = ordered.flatMap(([, mean, low, high]) => [mean, low ?? mean, high ?? mean]);
  const x = scale({ zero: view.zero }, ends, left, width - 16);
  gridlines(svg, x, ticks(x, width / 110), 4, height - 40, true, shown);
  if (view.zero) shape(svg, "line", { x1: x.at(0), x2: x.at(0), y1: 4, y2: height - 40, stroke: "var(--ink)" });
  ordered.forEach(([name, mean, low, high], i) => {
    const y = i * row + row - 9;
    const letters = Math.floor((narrow ? width - 24 : left - 20) / 7);
    const short = name.length > letters ? `…${name.slice(1 - letters)}` : name;
    const place = narrow ? { x: 12, y: y - 12 } : { x: left - 10, y: y + 4, "text-anchor": "end" };
    shape(svg, "text", place, short);
    if (low !== null) shape(svg, "line", { x1: x.at(low), x2: x.at(high), y1: y, y2: y, stroke: color(0), "stroke-width": 3 });
    shape(svg, "circle", { cx: x.at(mean), cy: y, r: 4.5, fill: color(0) });
  });
  shape(svg, "text", { x: (left + width - 16) / 2, y: height - 6, "text-anchor": "middle" }, view.name);
  return svg;
}
