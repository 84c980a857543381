// The player of episodes: a map, and plots over time that share one axis and one cursor.

const FRAME_MS = 60;
const RULE = "speed-rule";
const FATES = { a: "accepted", r: "rejected", m: "missing" };
const FILLS = { a: "var(--accepted)", r: "var(--rejected)", m: "var(--missing)" };

function player(place, episodes) {
  const state = { episode: 0, main: null, beside: null, at: 0, timer: null };
  const play = element("button", { type: "button", id: "play" }, "Play");
  const slider = element("input", { type: "range", min: 0, step: 1, value: 0, id: "time", "aria-label": "Epoch" });
  const now = element("p", { id: "now", role: "status", "aria-live": "off" });
  const map = element("div", { id: "map" });
  const strips = element("div", { id: "strips" });
  const key = element("div");
  const choices = element("div", { class: "controls" });
  place.append(choices, element("div", { class: "controls" }, play, slider), now, element("div", { class: "episode" }, map, strips), key);
  let cursor = () => {};

  function choose() {
    const names = Object.keys(episodes[state.episode].contenders);
    if (!names.includes(state.main)) [state.main] = names;
    if (state.beside === null) state.beside = names.includes(RULE) ? RULE : "";
    if (!names.includes(state.beside) || state.beside === state.main) state.beside = "";
    const others = ["none", ...names.filter((name) => name !== state.main)];
    const focused = document.activeElement && document.activeElement.id;
    choices.replaceChildren(
      selector("which", "Episode", episodes.map((episode) => episode.name), state.episode, (i) => { state.episode = i; state.at = 0; choose(); }),
      selector("main", "Contender", names, names.indexOf(state.main), (i) => { state.main = names[i]; choose(); }),
      selector("beside", "Compared with", others, Math.max(0, others.indexOf(state.beside)), (i) => { state.beside = i ? others[i] : ""; choose(); }),
    );
    if (["which", "main", "beside"].includes(focused)) document.getElementById(focused).focus();
    draw();
  }

  function draw() {
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
    if (state.at >= Number(slider.max)) state.at = 0;
    play.textContent = "Pause";
    state.timer = setInterval(() => {
      state.at += 1;
      show();
      if (state.at >= Number(slider.max)) stop();
    }, FRAME_MS);
  });
  new ResizeObserver(draw).observe(place.querySelector(".episode"));
  choose();
}

function sentence(episode, chosen, at) {
  const said = chosen.map((name) => {
    const course = episode.contenders[name];
    const nees = course.nees[at] === null ? "" : `, NEES ${shown(course.nees[at])}`;
    const error = course.error_m[at] === null ? "" : `, error ${course.error_m[at]} m`;
    return `${name}: ${course.modes[course.mode[at]]}, estimated speed ${course.speed_mps[at]} m/s${error}${nees}`;
  });
  const speed = episode.speed_mps[at] === null ? "" : `, speed ${episode.speed_mps[at]} m/s`;
  return `${episode.time_s[at]} s${speed}. ${said.join("; ")}.`;
}

function legend(place, episode, chosen) {
  const modes = chosen.map((name, i) => {
    const course = episode.contenders[name];
    const line = shape(null, "svg", { viewBox: "0 0 26 8", width: 26, height: 8, "aria-hidden": "true" });
    shape(line, "path", { d: "M0 4L26 4", ...lineOf(i) });
    const title = element("span", {}, line, element("b", {}, titleOf(course, name)));
    return element("div", { class: "key" }, title, ...course.modes.map((mode, k) => swatch(course.colors[k], mode)));
  });
  const fates = Object.entries(FATES).map(([fate, name]) => swatch(FILLS[fate], `measurement ${name}`));
  const notes = `Measurements, links and the ellipse of 2 standard deviations belong to ${chosen[0]}. The true speed has the color of the text. If the covariances are right, 95 % of the NEES values are in the band. Triangles are the gNB and other anchors; arrows point to anchors outside the map.`;
  place.replaceChildren(...modes, element("div", { class: "key" }, ...fates, element("span", {}, notes)));
}

const titleOf = (course, name) => `${name}: ${course.weighed ? "most probable mode" : "mode"}`;

function selector(id, label, names, chosen, choose) {
  const select = element("select", { id }, ...names.map((name, i) => element("option", { value: i }, name)));
  select.value = chosen;
  select.addEventListener("change", () => choose(Number(select.value)));
  return element("label", {}, label, select);
}

function swatch(fill, name) {
  const patch = element("i");
  patch.style.background = fill;
  return element("span", {}, patch, name);
}

function lineOf(number) {
  const stroke = number < 0 ? "var(--truth)" : number ? "var(--beside)" : "var(--accent)";
  return { fill: "none", stroke, "stroke-width": 1.5, "stroke-dasharray": number > 0 ? "5 3" : "" };
}

// --- plots over time

function drawStrips(place, episode, chosen) {
  const width = Math.max(260, place.clientWidth);
  const [left, right] = [74, width - 10];
  const courses = chosen.map((name) => episode.contenders[name]);
  const words = `Plots over time for ${chosen.join(" and ")}: modes, speed, position error, NEES with its 95 % bounds, and gates of every measurement.`;
  const svg = picture(width, 250 + 36 * courses.length + 15 * episode.groups.length + 44, words);
  const [first, last] = [episode.time_s[0], episode.time_s[episode.time_s.length - 1]];
  const time = scale(first, last, left, right);
  const ts = episode.time_s.map(time);
  let top = 4;

  const cells = (values, y, tall, fill, name) => runs(values, (value, from, to) => {
    const cell = shape(svg, "rect", { x: ts[from], y, width: Math.max(0.5, ts[to] - ts[from]), height: tall, fill: fill(value) });
    shape(cell, "title", {}, name(value));
  });
  const strip = (tall, label, low, high, marks, log = false) => {
    const y = scale(low, high, top + tall, top, log);
    for (const mark of marks) {
      shape(svg, "line", { x1: left, x2: right, y1: y(mark), y2: y(mark), stroke: "var(--grid)" });
      shape(svg, "text", { x: left - 6, y: y(mark) + 4, "text-anchor": "end", class: "quiet" }, shown(mark));
    }
    const middle = top + tall / 2;
    shape(svg, "text", { x: 12, y: middle, "text-anchor": "middle", transform: `rotate(-90 12 ${middle})`, class: "quiet" }, label);
    top += tall + 14;
    return y;
  };
  const fromZero = (tall, label, values) => {
    const most = 1.04 * largest(values, 0) || 1;
    return strip(tall, label, 0, most, ticks(0, most, 3));
  };
  const line = (values, y, i) => shape(svg, "path", { d: path(ts, pixels(values, y)), ...lineOf(i) });

  courses.forEach((course, i) => {
    shape(svg, "text", { x: left, y: top + 11, class: "quiet" }, titleOf(course, chosen[i]));
    cells(course.mode, top + 16, 16, (mode) => course.colors[mode], (mode) => course.modes[mode]);
    top += 36;
  });
  top += 4;
  const known = episode.speed_mps.some((v) => v !== null); // a log may have no ground truth
  const most = known ? 2 * Math.max(1, ...episode.speed_mps) : Infinity; // higher speeds are drawn at this speed
  const speeds = courses.map((course) => course.speed_mps.map((v) => (v === null ? null : Math.min(v, most))));
  const speed = fromZero(46, "speed m/s", [...episode.speed_mps, ...speeds.flat()]);
  speeds.forEach((values, i) => line(values, speed, i));
  line(episode.speed_mps, speed, -1);
  const error = fromZero(76, "error m", courses.flatMap((course) => course.error_m));
  courses.forEach((course, i) => line(course.error_m, error, i));
  const worst = largest(courses.flatMap((course) => course.nees), 100);
  const nees = strip(76, "NEES", 0.01, worst, [0.1, 1, 10, 100], true);
  const [low, high] = episode.nees_bounds.map(nees);
  shape(svg, "rect", { x: left, y: high, width: right - left, height: low - high, fill: "var(--band)", opacity: 0.6 });
  courses.forEach((course, i) => line(course.nees, nees, i));
  episode.groups.forEach((group, g) => {
    shape(svg, "text", { x: 68, y: top + 10, "text-anchor": "end", class: "quiet" }, group);
    cells([...courses[0].fate[g]], top + 2, 8, (fate) => FILLS[fate], (fate) => `${group} ${FATES[fate]}`);
    top += 15;
  });
  top += 8;
  for (const mark of ticks(first, last, width / 90)) {
    shape(svg, "text", { x: time(mark), y: top + 4, "text-anchor": "middle", class: "quiet" }, shown(mark));
  }
  shape(svg, "text", { x: (left + right) / 2, y: top + 22, "text-anchor": "middle" }, "time (s)");
  const cursor = shape(svg, "line", { y1: 0, y2: top - 10, stroke: "var(--ink)", "stroke-width": 1.5 });
  place.replaceChildren(svg);
  return (at) => change(cursor, { x1: ts[at], x2: ts[at] });
}

// Calls take(value, from, to) for every run of equal values: `from` is its first epoch, and `to` is the first epoch of the next run, or the last epoch.
function runs(values, take) {
  let begin = 0;
  for (let k = 1; k <= values.length; k += 1) {
    if (k === values.length || values[k] !== values[begin]) {
      take(values[begin], begin, Math.min(k, values.length - 1));
      begin = k;
    }
  }
}

const { episodes } = JSON.parse(document.getElementById("data").textContent);
if (episodes.length) player(document.getElementById("player"), episodes);
