// The map of an episode: streets, walls, anchors with their links, the true way and the estimates.

function drawMap(place, episode, chosen) {
  const width = Math.max(260, place.clientWidth);
  const height = Math.min(560, Math.max(300, 0.95 * width));
  const words = `Map of ${episode.name}: the true way, and the estimates of ${chosen.join(" and ")}. North is up.`;
  const svg = picture(width, height, words);
  const courses = chosen.map((name) => episode.contenders[name]);
  const [toX, toY, perMeter] = mapScale(episode, courses, width, height);
  shape(svg, "rect", { width, height, fill: "var(--ground)" });
  drawStreets(svg, episode, toX, toY, perMeter);
  const links = episode.anchors.map(() => shape(svg, "line", { "stroke-width": 1.4 }));
  const xs = episode.x.map((v) => (v === null ? null : toX(v))); // of a log without truth: none
  const ys = episode.y.map((v) => (v === null ? null : toY(v)));
  shape(svg, "path", { d: path(xs, ys), fill: "none", stroke: "var(--ink)", "stroke-width": 1, opacity: 0.35 });
  const trails = courses.map((course, i) => trail(svg, course, toX, toY, i));
  drawAnchors(svg, episode, toX, toY, width, height);
  const ellipse = shape(svg, "ellipse", { fill: "var(--c0)", "fill-opacity": 0.15, stroke: "var(--ink)" });
  const user = shape(svg, "circle", { r: 5, fill: "var(--ink)", stroke: "var(--paper)", "stroke-width": 1.5 });
  const estimates = courses.map((_, i) => shape(svg, "circle", { r: 4.5, fill: "var(--paper)", stroke: i ? "var(--rejected)" : "var(--accent)", "stroke-width": 2.5 }));
  drawScale(svg, perMeter, height);
  place.replaceChildren(svg);
  return (at) => {
    const here = xs[at] === null ? [toX(courses[0].x[at] ?? 0), toY(courses[0].y[at] ?? 0)] : [xs[at], ys[at]];
    user.setAttribute("visibility", xs[at] === null ? "hidden" : "visible");
    user.setAttribute("cx", here[0]);
    user.setAttribute("cy", here[1]);
    courses.forEach((course, i) => {
      trails[i](at);
      estimates[i].setAttribute("visibility", course.x[at] === null ? "hidden" : "visible");
      estimates[i].setAttribute("cx", toX(course.x[at] ?? 0));
      estimates[i].setAttribute("cy", toY(course.y[at] ?? 0));
    });
    placeEllipse(ellipse, courses[0], at, toX, toY, perMeter);
    episode.anchors.forEach(([x, y], i) => {
      const fate = courses[0].fate[i][at];
      const ends = { x1: here[0], y1: here[1], x2: toX(x), y2: toY(y), stroke: FILLS[fate], "stroke-dasharray": fate === "r" ? "6 4" : "" };
      for (const [key, value] of Object.entries(ends)) links[i].setAttribute(key, value);
    });
  };
}

function mapScale(episode, courses, width, height) {
  const xs = [...episode.x, ...courses.flatMap((course) => course.x)].filter((v) => v !== null);
  const ys = [...episode.y, ...courses.flatMap((course) => course.y)].filter((v) => v !== null);
  const least = (values) => values.reduce((a, b) => Math.min(a, b));
  const most = (values) => values.reduce((a, b) => Math.max(a, b));
  const [west, east, south, north] = [least(xs), most(xs), least(ys), most(ys)];
  const room = 44;
  const perMeter = Math.min((width - room) / Math.max(east - west, 40), (height - room) / Math.max(north - south, 40));
  const toX = (x) => width / 2 + (x - (west + east) / 2) * perMeter;
  const toY = (y) => height / 2 - (y - (south + north) / 2) * perMeter;
  return [toX, toY, perMeter];
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
  const [gnb, ...images] = episode.anchors;
  for (const image of images) {
    const way = [image[0] - gnb[0], image[1] - gnb[1]];
    const far = Math.hypot(...way);
    if (far === 0 || Math.abs(image[2] - gnb[2]) > 0.1) continue;
    const middle = [(image[0] + gnb[0]) / 2, (image[1] + gnb[1]) / 2];
    const along = [(-way[1] / far) * 5000, (way[0] / far) * 5000];
    shape(svg, "line", {
      x1: toX(middle[0] - along[0]), y1: toY(middle[1] - along[1]), x2: toX(middle[0] + along[0]), y2: toY(middle[1] + along[1]),
      stroke: "var(--wall)", "stroke-width": 3,
    });
  }
}

// One outside is an arrow at the rim, in its direction from the middle. Names are where no other sign or name is.
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

// The way of an estimate until now: the first contender's in the colors of its modes.
function trail(svg, course, toX, toY, number) {
  const xs = course.x.map((v) => (v === null ? null : toX(v)));
  const ys = course.y.map((v) => (v === null ? null : toY(v)));
  if (number) {
    const line = shape(svg, "path", { fill: "none", stroke: "var(--rejected)", "stroke-width": 1.6, "stroke-dasharray": "5 3" });
    return (at) => line.setAttribute("d", path(xs.slice(0, at + 1), ys.slice(0, at + 1)));
  }
  const lines = course.modes.map((_, i) => shape(svg, "path", { fill: "none", stroke: modeColor(course, i), "stroke-width": 2.6 }));
  return (at) => {
    const parts = course.modes.map(() => "");
    for (let k = 1; k <= at; k += 1) parts[course.mode[k]] += path(xs.slice(k - 1, k + 1), ys.slice(k - 1, k + 1));
    lines.forEach((line, i) => line.setAttribute("d", parts[i]));
  };
}

// Two standard deviations.
function placeEllipse(ellipse, course, at, toX, toY, perMeter) {
  const [xx, xy, yy] = course.P.map((row) => row[at]);
  const known = [xx, xy, yy, course.x[at], course.y[at]].every(Number.isFinite);
  ellipse.setAttribute("visibility", known ? "visible" : "hidden");
  if (!known) return;
  const mean = (xx + yy) / 2;
  const spread = Math.hypot((xx - yy) / 2, xy);
  const turn = (Math.atan2(2 * xy, xx - yy) / 2) * (-180 / Math.PI);
  const [x, y] = [toX(course.x[at]), toY(course.y[at])];
  const axes = { rx: 2 * Math.sqrt(Math.max(0, mean + spread)) * perMeter, ry: 2 * Math.sqrt(Math.max(0, mean - spread)) * perMeter };
  const sizes = { cx: x, cy: y, ...axes, transform: `rotate(${turn} ${x} ${y})` };
  for (const [key, value] of Object.entries(sizes)) ellipse.setAttribute(key, value);
}

function drawScale(svg, perMeter, height) {
  const meters = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find((m) => m * perMeter > 50) ?? 2000;
  const y = height - 12;
  shape(svg, "path", { d: `M12 ${y - 5}V${y}H${12 + meters * perMeter}V${y - 5}`, fill: "none", stroke: "var(--ink)", "stroke-width": 1.5 });
  shape(svg, "text", { x: 18, y: y - 6 }, `${meters} m`);
}

