// The map of an episode: streets, walls, anchors with their links, the true track and the estimates.

function drawMap(place, episode, chosen) {
  const width = Math.max(260, place.clientWidth);
  const height = Math.min(560, Math.max(300, 0.95 * width));
  const svg = picture(width, height, `Map of ${episode.name}: the true track, and the estimates of ${chosen.join(" and ")}. North is up.`);
  const courses = chosen.map((name) => episode.contenders[name]);
  const [toX, toY, perMeter] = mapScale(episode, courses, width, height);
  const placed = (track) => [pixels(track.x, toX), pixels(track.y, toY)]; // coordinates are null where a log has no ground truth
  shape(svg, "rect", { width, height, fill: "var(--ground)" });
  drawStreets(svg, episode, toX, toY, perMeter);
  const links = episode.anchors.map(() => shape(svg, "line", { "stroke-width": 1.4 }));
  const [xs, ys] = placed(episode);
  shape(svg, "path", { d: path(xs, ys), fill: "none", stroke: "var(--truth)", "stroke-width": 1, opacity: 0.35 });
  const trails = courses.map((course, i) => trail(svg, course, ...placed(course), i));
  drawAnchors(svg, episode, toX, toY, width, height);
  const ellipse = shape(svg, "ellipse", { fill: "var(--accent)", "fill-opacity": 0.15, stroke: "var(--ink)" });
  const user = shape(svg, "circle", { r: 5, fill: "var(--truth)", stroke: "var(--paper)", "stroke-width": 1.5 });
  const estimates = courses.map((_, i) => shape(svg, "circle", { r: 4.5, fill: "var(--paper)", stroke: lineOf(i).stroke, "stroke-width": 2.5 }));
  const meters = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find((m) => m * perMeter > 50) ?? 2000;
  shape(svg, "path", { d: `M12 ${height - 17}v5h${meters * perMeter}v-5`, fill: "none", stroke: "var(--ink)", "stroke-width": 1.5 });
  shape(svg, "text", { x: 18, y: height - 18 }, `${meters} m`);
  place.replaceChildren(svg);
  return (at) => {
    const put = (node, x, y, more) => change(node, { visibility: x === null ? "hidden" : "visible", cx: x ?? 0, cy: y ?? 0, ...more });
    put(user, xs[at], ys[at]);
    const now = courses.map((course) => [pixels([course.x[at]], toX)[0], pixels([course.y[at]], toY)[0]]);
    now.forEach(([x, y], i) => { trails[i](at); put(estimates[i], x, y); });
    const [x, y] = now[0];
    const [long, short, turn] = courses[0].ellipse.map((values) => values[at] ?? 0);
    put(ellipse, x, y, { rx: long * perMeter, ry: short * perMeter, transform: `rotate(${turn} ${x ?? 0} ${y ?? 0})` });
    const [x1, y1] = xs[at] === null ? [x ?? 0, y ?? 0] : [xs[at], ys[at]];
    episode.anchors.forEach((anchor, i) => {
      const fate = courses[0].fate[i][at];
      change(links[i], { x1, y1, x2: toX(anchor[0]), y2: toY(anchor[1]), stroke: FILLS[fate], "stroke-dasharray": fate === "r" ? "6 4" : "" });
    });
  };
}

function mapScale(episode, courses, width, height) {
  const ends = (axis) => {
    const known = [episode, ...courses].flatMap((track) => track[axis]).filter((v) => v !== null);
    return [known.reduce((a, b) => Math.min(a, b)), known.reduce((a, b) => Math.max(a, b))];
  };
  const [[west, east], [south, north]] = [ends("x"), ends("y")];
  // A margin of 22 px is left free on each side.
  const perMeter = Math.min((width - 44) / Math.max(east - west, 40), (height - 44) / Math.max(north - south, 40));
  const middle = [(west + east) / 2, (south + north) / 2];
  return [(x) => width / 2 + (x - middle[0]) * perMeter, (y) => height / 2 - (y - middle[1]) * perMeter, perMeter];
}

function drawStreets(svg, episode, toX, toY, perMeter) {
  const streets = episode.streets;
  if (streets) {
    const half = Math.min(14, streets.block / 4) / 2;
    const box = (x, y, w, h, fill) => shape(svg, "rect", { x: toX(x), y: toY(y + h), width: w * perMeter, height: h * perMeter, fill });
    const [[west, east], [south, north]] = [streets.x, streets.y];
    box(west - half, south - half, east - west + 2 * half, north - south + 2 * half, "var(--street)");
    for (let x = west; x < east - 1e-6; x += streets.block) {
      for (let y = south; y < north - 1e-6; y += streets.block) {
        box(x + half, y + half, streets.block - 2 * half, streets.block - 2 * half, "var(--building)");
      }
    }
  }
  const [[gx, gy], ...others] = episode.anchors;
  for (const [x, y] of others.slice(0, episode.images)) { // each image is the gNB's mirror image in a wall, so the wall is the perpendicular bisector between gNB and image
    const far = Math.hypot(x - gx, y - gy);
    if (far === 0) continue;
    const [dx, dy] = [(-5000 * (y - gy)) / far, (5000 * (x - gx)) / far];
    const [mx, my] = [(x + gx) / 2, (y + gy) / 2];
    shape(svg, "line", { x1: toX(mx - dx), y1: toY(my - dy), x2: toX(mx + dx), y2: toY(my + dy), stroke: "var(--wall)", "stroke-width": 3 });
  }
}

// An anchor outside the map is drawn as an arrow at the rim that points to the anchor. Names are placed where they cover neither symbols nor other names.
function drawAnchors(svg, episode, toX, toY, width, height) {
  const margin = 14;
  const signs = episode.anchors.map(([x, y], i) => {
    const [dx, dy] = [toX(x) - width / 2, toY(y) - height / 2];
    const inside = Math.min(1, (width / 2 - margin) / Math.abs(dx), (height / 2 - margin) / Math.abs(dy));
    const [inX, inY] = [width / 2 + inside * dx, height / 2 + inside * dy];
    const turn = inside < 1 ? `rotate(${(Math.atan2(dx, -dy) * 180) / Math.PI} ${inX} ${inY})` : "";
    const sign = turn ? "l6 15l-6 -4l-6 4Z" : "l7 13l-14 0Z";
    shape(svg, "path", { d: `M${inX} ${inY - 8}${sign}`, fill: i ? "var(--paper)" : "var(--ink)", stroke: "var(--ink)", "stroke-width": 1.5, transform: turn });
    return [inX, inY + 4];
  });
  const names = [];
  signs.forEach((own, i) => {
    const [x, y] = own;
    const taken = [...signs.filter((other) => other !== own), ...names];
    let below = y;
    while (taken.some(([a, b]) => Math.abs(a - x) < 80 && Math.abs(b - below) < 14)) below += y > height / 2 ? -15 : 15;
    names.push([x, below]);
    const right = x > width / 2;
    shape(svg, "text", { x: x + (right ? -12 : 12), y: below, "text-anchor": right ? "end" : "start" }, episode.groups[i]);
  });
}

// Draws an estimated track, and returns a function that shows the track up to an epoch. The track of contender number 0 has the colors of its modes.
function trail(svg, course, xs, ys, number) {
  if (number) {
    const line = shape(svg, "path", lineOf(number));
    return (at) => change(line, { d: path(xs.slice(0, at + 1), ys.slice(0, at + 1)) });
  }
  const lines = course.colors.map((stroke) => shape(svg, "path", { fill: "none", stroke, "stroke-width": 2.6 }));
  return (at) => {
    const parts = course.modes.map(() => "");
    for (let k = 1; k <= at; k += 1) parts[course.mode[k]] += path(xs.slice(k - 1, k + 1), ys.slice(k - 1, k + 1));
    lines.forEach((line, i) => change(line, { d: parts[i] }));
  };
}
