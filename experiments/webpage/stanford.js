// Stanford diagrams: how often errors and protection levels are so large, in logarithmic cells.

const LARGEST = 520; // pixels of a side

function stanford(view, title, width) {
  const side = Math.min(width - 72, LARGEST);
  const frame = { left: 58, right: 58 + side, top: 10, bottom: 10 + side };
  const said = Object.entries(view.regions).map(([name, share]) => `${name} ${share}`).join(", ");
  const svg = picture(width, side + 72, `${title}: ${view.name}. ${said} of the epochs, at an alert limit of ${shown(view.limit)} m.`);
  const axis = { log: true, from: view.ends[0], to: view.ends[1] };
  const x = scale(axis, [], frame.left, frame.right);
  const y = scale(axis, [], frame.bottom, frame.top);
  const values = ticks(x, side / 80);
  gridlines(svg, x, values, frame.top, frame.bottom, true, shown);
  gridlines(svg, y, values, frame.left, frame.right, false, shown);
  const cell = side / view.side;
  const most = Math.max(2, ...view.cells.map((one) => one[2]));
  for (const [i, j, count] of view.cells) {
    shape(svg, "rect", {
      x: (frame.left + i * cell).toFixed(1), y: (frame.bottom - (j + 1) * cell).toFixed(1),
      width: (cell + 0.2).toFixed(1), height: (cell + 0.2).toFixed(1), fill: color(0),
      opacity: (0.15 + (0.85 * Math.log(count)) / Math.log(most)).toFixed(2),
    });
  }
  const limit = { x: x.at(view.limit), y: y.at(view.limit) };
  const line = (x1, y1, x2, y2, style) => shape(svg, "line", { x1, y1, x2, y2, stroke: "var(--ink)", "stroke-dasharray": style });
  line(frame.left, frame.bottom, frame.right, frame.top, "");
  line(frame.left, limit.y, frame.right, limit.y, "6 4");
  line(limit.x, limit.y, limit.x, frame.bottom, "6 4");
  regionNames(svg, view.regions, frame, limit);
  shape(svg, "text", { x: (frame.left + frame.right) / 2, y: side + 46, "text-anchor": "middle" }, "position error (m)");
  const middle = (frame.top + frame.bottom) / 2;
  shape(svg, "text", { x: 13, y: middle, "text-anchor": "middle", transform: `rotate(-90 13 ${middle})` }, "protection level (m)");
  const fullest = `in a cell 1 (light) to ${shown(most)} epochs (dark)`;
  shape(svg, "text", { x: (frame.left + frame.right) / 2, y: side + 64, "text-anchor": "middle", class: "quiet" }, fullest);
  return svg;
}

// Each where it is in the picture: words one above the other, the share below.
function regionNames(svg, regions, frame, limit) {
  const places = {
    nominal: [frame.left + 5, limit.y + 15, "start", 1],
    misleading: [limit.x - 5, frame.bottom - 6, "end", -1],
    "hazardously misleading": [limit.x + 5, frame.bottom - 6, "start", -1],
    unavailable: [frame.left + 5, frame.top + 13, "start", 1],
    "unavailable and misleading": [frame.right - 4, limit.y - 6, "end", -1],
  };
  for (const [name, share] of Object.entries(regions)) {
    const [x, y, anchor, step] = places[name];
    const words = [...name.replace(" and ", ",\n").replace("sly ", "sly\n").split("\n"), share];
    const first = step > 0 ? y : y - 14 * (words.length - 1);
    words.forEach((one, i) => shape(svg, "text", { x, y: first + 14 * i, "text-anchor": anchor, class: "outlined" }, one));
  }
}
