// The browser of episodes: a map, and strips on one axis of time, with a cursor on all of them.

const FRAME_MS = 60;
const FATES = { a: "accepted", r: "rejected", m: "missing" };
const FILLS = { a: "var(--quiet)", r: "var(--rejected)", m: "var(--missing)" };

function browser(place, episodes) {
  const state = { episode: mostTelling(episodes), main: null, beside: null, at: 0, timer: null };
  const controls = element("div", { class: "controls" });
  const play = element("button", { type: "button", id: "play" }, "Play");
  const slider = element("input", { type: "range", min: 0, step: 1, value: 0, id: "time", "aria-label": "Epoch" });
  const now = element("p", { class: "now", id: "now", role: "status", "aria-live": "off" });
  const map = element("div", { id: "map" });
  const strips = element("div", { id: "strips" });
  const key = element("div");
  const choices = element("div", { class: "controls" });
  controls.append(play, slider);
  place.append(choices, controls, now, element("div", { class: "episode" }, map, strips), key);
  let cursor = () => {};

  function choose() {
    const names = Object.keys(episodes[state.episode].contenders);
    if (!names.includes(state.main)) [state.main] = names;
    if (state.beside === null) state.beside = names.includes("speed-rule") ? "speed-rule" : "";
    if (!names.includes(state.beside) || state.beside === state.main) state.beside = "";
    const which = selector("Episode", episodes.map((one) => one.name), (i) => { state.episode = i; state.at = 0; choose(); });
    which.select.value = state.episode;
    const main = selector("Contender", names, (i) => { state.main = names[i]; choose(); });
    main.select.value = names.indexOf(state.main);
    const others = ["nobody", ...names.filter((name) => name !== state.main)];
    const beside = selector("Beside", others, (i) => { state.beside = i ? others[i] : ""; choose(); });
    beside.select.value = Math.max(0, others.indexOf(state.beside));
    for (const [one, id] of [[which, "which"], [main, "main"], [beside, "beside"]]) one.select.id = id;
    const focused = document.activeElement && document.activeElement.id;
    choices.replaceChildren(which.label, main.label, beside.label);
    if (["which", "main", "beside"].includes(focused)) document.getElementById(focused).focus();
    draw();
  }

  function draw() {
    if (!place.clientWidth) return; // in a hidden section
    const episode = episodes[state.episode];
    slider.max = episode.time_s.length - 1;
    const chosen = [state.main, ...(state.beside ? [state.beside] : [])];
    const onMap = drawMap(map, episode, chosen);
    const onStrips = drawStrips(strips, episode, chosen);
    legend(key, episode, chosen);
    cursor = (at) => { onMap(at); onStrips(at); now.textContent = sentence(episode, chosen, at); };
    show();
  }

  function show() {
    slider.value = state.at;
    slider.setAttribute("aria-valuetext", `${episodes[state.episode].time_s[state.at]} s`);
    cursor(state.at);
  }

  function stop() {
    clearInterval(state.timer);
    state.timer = null;
    play.textContent = "Play";
  }

  slider.addEventListener("input", () => { state.at = Number(slider.value); show(); });
  play.addEventListener("click", () => {
    if (state.timer) { stop(); return; }
    const last = Number(slider.max);
    if (state.at >= last) state.at = 0;
    play.textContent = "Pause";
    state.timer = setInterval(() => {
      state.at = Math.min(state.at + 1, Number(slider.max));
      show();
      if (state.at >= Number(slider.max)) stop();
    }, FRAME_MS);
  });
  redraws.push(draw);
  choose();
}

// Where to begin: the episode in which the first contender and the rule are furthest apart.
function mostTelling(episodes) {
  const apart = episodes.map(({ contenders }) => {
    const [one] = Object.values(contenders);
    const other = contenders["speed-rule"] ?? one;
    return one.error_m.reduce((sum, error, k) => sum + Math.abs((error ?? 0) - (other.error_m[k] ?? 0)), 0);
  });
  return apart.indexOf(Math.max(...apart));
}

function modeOf(course, at) {
  return course.modes[course.mode[at]] ?? "none";
}

function modeColor(course, number) {
  const first = course.modes[0] === "none" ? 1 : 0;
  return number < first ? "var(--missing)" : color(number - first);
}

function sentence(episode, chosen, at) {
  const said = chosen.map((name) => {
    const course = episode.contenders[name];
    const nees = course.nees[at] === null ? "" : `, NEES ${shown(course.nees[at])}`;
    const error = course.error_m[at] === null ? "" : `, error ${course.error_m[at]} m`;
    return `${name}: ${modeOf(course, at)}, believes ${course.speed_mps[at]} m/s${error}${nees}`;
  });
  return `${episode.time_s[at]} s, speed ${episode.speed_mps[at]} m/s. ${said.join("; ")}.`;
}

function legend(place, episode, chosen) {
  const modes = chosen.map((name, i) => {
    const course = episode.contenders[name];
    const line = shape(null, "svg", { viewBox: "0 0 26 8", width: 26, height: 8, "aria-hidden": "true" });
    shape(line, "path", { d: "M0 4L26 4", ...lineOf(i) });
    const ribbons = course.modes.map((mode, k) => swatch(modeColor(course, k), mode));
    const words = `${name}: ${course.weighed ? "most probable " : ""}mode ${i + 1}`;
    return element("div", { class: "key" }, element("span", {}, line, element("b", {}, words)), ...ribbons);
  });
  const fates = Object.entries(FATES).map(([fate, name]) => swatch(FILLS[fate], `measurement ${name}`));
  const notes = element("span", {}, `Of ${chosen[0]}: measurements, links, NIS (dots; dashed: 99 % quantile of each kind), ellipse of 2 standard deviations. Black line: the true speed. Band: 95 % of NEES. Triangle: gNB or anchor, as an arrow one outside the map.`);
  place.replaceChildren(...modes, element("div", { class: "key" }, ...fates, notes));
}

function swatch(fill, name) {
  const patch = element("i");
  patch.style.background = fill;
  return element("span", {}, patch, name);
}

function lineOf(number) {
  const stroke = number < 0 ? "var(--ink)" : number ? "var(--rejected)" : "var(--accent)";
  return { fill: "none", stroke, "stroke-width": 1.5, "stroke-dasharray": number > 0 ? "5 3" : "" };
}

// --- strips over time

function drawStrips(place, episode, chosen) {
  const width = Math.max(260, place.clientWidth);
  const left = 74;
  const right = width - 10;
  const courses = chosen.map((name) => episode.contenders[name]);
  const rows = stripHeights(courses.length, episode.groups.length);
  const height = rows.end + 40;
  const words = `Over time, of ${chosen.join(" and ")}: modes, speed, position error, NEES with its 95 % bounds, gates and NIS of every measurement.`;
  const svg = picture(width, height, words);
  const time = scale({ from: episode.time_s[0], to: episode.time_s[episode.time_s.length - 1] }, [], left, right);
  const ts = episode.time_s.map(time.at);
  courses.forEach((course, i) => ribbon(svg, ts, course, rows.modes + 24 * i, `mode${courses.length > 1 ? ` ${i + 1}` : ""}`));
  const line = (values, y, i) => shape(svg, "path", {
    d: path(ts, values.map((v) => (v === null || (y.log && v <= 0) ? null : y.at(v)))),
    ...lineOf(i),
  });
  const strip = (top, tall, axis, values, label, marks) => {
    const y = scale(axis, values, top + tall, top + 4);
    gridlines(svg, y, marks ?? ticks(y, 3), left, right, false, shown);
    stripLabel(svg, top + tall / 2, label);
    return y;
  };
  const most = 2 * Math.max(1, ...episode.speed_mps); // beliefs far beyond are drawn at the edge
  const speeds = courses.map((course) => course.speed_mps.map((v) => (v === null ? null : Math.min(v, most))));
  const speed = strip(rows.speed, 50, { from: 0 }, [...episode.speed_mps, ...speeds.flat()], "speed m/s");
  speeds.forEach((values, i) => line(values, speed, i));
  line(episode.speed_mps, speed, -1);
  const errors = courses.flatMap((course) => course.error_m);
  const error = strip(rows.error, 80, { from: 0 }, errors, "error m");
  courses.forEach((course, i) => line(course.error_m, error, i));
  const [low, high] = episode.nees_bounds;
  const nees = strip(rows.nees, 80, { log: true, from: 0.01 }, [...courses.flatMap((course) => course.nees), 100], "NEES", [0.1, 1, 10, 100]);
  shape(svg, "rect", { x: left, y: nees.at(high), width: right - left, height: nees.at(low) - nees.at(high), fill: "var(--band)", opacity: 0.6 });
  courses.forEach((course, i) => line(course.nees, nees, i));
  gates(svg, ts, episode, courses[0], rows.gates);
  nisStrip(svg, ts, episode, courses[0], rows.nis, left, right);
  gridlines(svg, time, ticks(time, width / 90), rows.end, rows.end, true, shown);
  shape(svg, "text", { x: (left + right) / 2, y: height - 6, "text-anchor": "middle" }, "time (s)");
  const cursor = shape(svg, "line", { y1: 0, y2: rows.end, stroke: "var(--ink)", "stroke-width": 1.5 });
  place.replaceChildren(svg);
  return (at) => { cursor.setAttribute("x1", ts[at]); cursor.setAttribute("x2", ts[at]); };
}

function stripHeights(courses, groups) {
  const rows = { modes: 4 };
  rows.speed = rows.modes + 24 * courses + 4;
  rows.error = rows.speed + 62;
  rows.nees = rows.error + 92;
  rows.gates = rows.nees + 92;
  rows.nis = rows.gates + 15 * groups + 8;
  rows.end = rows.nis + 96;
  return rows;
}

function stripLabel(svg, y, label) {
  shape(svg, "text", { x: 12, y, "text-anchor": "middle", transform: `rotate(-90 12 ${y})`, class: "quiet" }, label);
}

// Cells of equal values, from one epoch to the next.
function runs(values, take) {
  let begin = 0;
  for (let k = 1; k <= values.length; k += 1) {
    if (k === values.length || values[k] !== values[begin]) {
      take(values[begin], begin, Math.min(k, values.length - 1));
      begin = k;
    }
  }
}

function ribbon(svg, ts, course, top, label) {
  shape(svg, "text", { x: 68, y: top + 14, "text-anchor": "end", class: "quiet" }, label);
  runs(course.mode, (mode, from, to) => {
    const cell = shape(svg, "rect", { x: ts[from], y: top, width: Math.max(0.5, ts[to] - ts[from]), height: 20, fill: modeColor(course, mode) });
    shape(cell, "title", {}, `${course.modes[mode]}${course.weighed ? ", the most probable" : ""}`);
  });
}

function gates(svg, ts, episode, course, top) {
  episode.groups.forEach((group, g) => {
    const y = top + 15 * g;
    shape(svg, "text", { x: 68, y: y + 10, "text-anchor": "end", class: "quiet" }, group);
    shape(svg, "circle", { cx: 5, cy: y + 6, r: 3, fill: color(g) }); // of its NIS below
    runs([...course.fate[g]], (fate, from, to) => {
      const cell = shape(svg, "rect", { x: ts[from], y: fate === "r" ? y : y + 3, width: Math.max(0.5, ts[to] - ts[from]), height: fate === "r" ? 12 : 6, fill: FILLS[fate] });
      shape(cell, "title", {}, `${group} ${FATES[fate]}`);
    });
  });
}

// NIS over its degrees of freedom, of which a consistent filter has 1 on average.
function nisStrip(svg, ts, episode, course, top, left, right) {
  const y = scale({ log: true, from: 0.01, to: 100 }, [], top + 90, top + 4);
  gridlines(svg, y, [0.1, 1, 10], left, right, false, shown);
  stripLabel(svg, top + 46, "NIS / dof");
  course.nis.forEach((values, g) => {
    const dof = episode.rows[g];
    const gate = y.at(episode.limits[g] / dof);
    shape(svg, "line", { x1: left, x2: right, y1: gate, y2: gate, stroke: color(g), "stroke-dasharray": "4 4" });
    values.forEach((nis, k) => {
      const fate = course.fate[g][k];
      if (fate === "m" || nis === null || nis <= 0) return;
      const at = { x: ts[k], y: y.at(Math.min(100, nis / dof)) };
      if (fate === "r") {
        shape(svg, "path", { d: `M${at.x - 3} ${at.y - 3}l6 6m0-6l-6 6`, stroke: "var(--rejected)", "stroke-width": 1.8 });
      } else {
        shape(svg, "circle", { cx: at.x, cy: at.y, r: 1.6, fill: color(g) });
      }
    });
  });
}
