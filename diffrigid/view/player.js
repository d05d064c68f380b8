// The data of a player, its clock and its controls. What draws the motion is `makeView`, in flat.js or solid.js, and the
// graph is `makeGraph`, in graph.js.

const SPEEDS = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10];
const TOGGLES = { trails: "Trails", velocities: "Velocities", contacts: "Contacts", data: "Measured" };
const HELP = "space: play or pause; left, right: one frame; up, down: speed; home, end; plus, minus: zoom; 0: whole view";

// ---- the data: see frames.py

const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;

function unpack({ low, step, rows, data }) {
  const whole = new Uint16Array(bytes(data));
  return low.map((start, k) => Float64Array.from(whole.subarray(k * rows, (k + 1) * rows), (n) => (n === 65535 ? NaN : start + step[k] * n)));
}

function unpackTimes(t) {
  if (typeof t === "string") return new Float64Array(bytes(t));
  const [first, last, steps] = t;
  return Float64Array.from({ length: steps + 1 }, (_, k) => first + ((last - first) * k) / (steps || 1));
}

// Index of the last of the increasing `times` that is <= t, at least 0.
function before(times, t) {
  let low = 0, high = times.length;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t) low = middle; else high = middle;
  }
  return low;
}

// How a body moves between two frames, h seconds apart, from x0 with v0 to x1 with v1: on a "curve"; or with a corner
// {s, x} where two straight lines meet, if the velocity jumps, which means an impact; or on a "line" if nothing fits.
// `calm` is the square of the change of velocity in the intervals beside.
function passage({ x: x0, v: v0 }, { x: x1, v: v1 }, h, calm) {
  let jump = 0, off = 0, pull = 0, apart = 0;
  x0.forEach((x, i) => {
    jump += (v1[i] - v0[i]) ** 2;
    off += (x1[i] - x - (h * (v0[i] + v1[i])) / 2) ** 2;
    pull += (x1[i] - x - v1[i] * h) * (v0[i] - v1[i]);
  });
  const smooth = off <= 1e-12 + (0.05 * h) ** 2 * jump;
  if (smooth && jump <= 9 * calm) return "curve";
  const s = pull / jump, ends = x0.map((x, i) => [x + v0[i] * s, x1[i] - v1[i] * (h - s)]);
  for (const [a, b] of ends) apart += (a - b) ** 2;
  if (!(s > 0 && s < h) || apart > (0.25 * h) ** 2 * jump) return smooth ? "curve" : "line";
  return { s, x: ends.map(([a, b]) => (a + b) / 2) };
}

// Place and velocity s seconds after x0.
function between({ x: x0, v: v0 }, { x: x1, v: v1 }, h, way, s) {
  const u = s / h, mix = (a, b, u) => a.map((n, i) => n + (b[i] - n) * u);
  if (way === "line") return { x: mix(x0, x1, u), v: mix(v0, v1, u) };
  if (way !== "curve") return s < way.s ? { x: mix(x0, way.x, s / way.s), v: v0 } : { x: mix(way.x, x1, (s - way.s) / (h - way.s)), v: v1 };
  const x = x0.map((a, i) => (1 + 2 * u) * (1 - u) ** 2 * a + u * u * (3 - 2 * u) * x1[i] + h * u * (1 - u) * ((1 - u) * v0[i] - u * v1[i]));
  return { x, v: mix(v0, v1, u) };
}

// All passages of a body.
function passages(states, t) {
  const jump = states.slice(1).map(({ v }, k) => v.reduce((sum, n, i) => sum + (n - states[k].v[i]) ** 2, 0));
  return jump.map((_, k) => passage(states[k], states[k + 1], t[k + 1] - t[k], jump.length < 2 ? Infinity : Math.max(jump[k - 1] ?? 0, jump[k + 1] ?? 0)));
}

function turned(a, b, u) {
  if (a.length === 1) return [a[0] + (b[0] - a[0]) * u];
  const cosine = Math.min(a.reduce((sum, n, i) => sum + n * b[i], 0), 1), angle = Math.acos(cosine);
  const [p, r] = angle < 1e-4 ? [1 - u, u] : [Math.sin((1 - u) * angle), Math.sin(u * angle)];
  const q = a.map((n, i) => p * n + r * b[i]), size = Math.hypot(...q);
  return q.map((n) => n / size);
}

function makeRun(source, dim) {
  const turns = dim === 2 ? 1 : 4, width = 2 * dim + turns;
  const t = unpackTimes(source.t), columns = unpack(source.poses);
  const pick = (table, body, k, from, to) => table.slice(body * width + from, body * width + to).map((column) => column[k]);
  const stored = (table, body, k) => ({
    x: pick(table, body, k, 0, dim), q: pick(table, body, k, dim, dim + turns), v: pick(table, body, k, dim + turns, width),
  });
  const run = { ...source, t, first: t[0], last: t[t.length - 1], contacts: unpack(source.contacts), energy: unpack(source.energy) };
  run.at = (body, k) => stored(columns, body, k);
  run.pose = (body, time) => {
    const k = Math.min(before(t, time), t.length - 2), a = run.at(body, k), b = run.at(body, k + 1), h = t[k + 1] - t[k];
    const s = Math.min(Math.max(time - t[k], 0), h);
    return s === 0 ? a : s === h ? b : { ...between(a, b, h, ways[body][k], s), q: turned(a.q, b.q, s / h) };
  };
  const ways = source.bodies.map((_, body) => passages(Array.from(t, (_, k) => run.at(body, k)), t));
  run.trails = ways.map((ways, body) => [...t].flatMap((time, k) => [
    [time, ...run.at(body, k).x], ...(ways[k]?.s ? [[time + ways[k].s, ...ways[k].x]] : []),
  ]));
  const still = source.statics.map((pose) => ({ x: pose.slice(0, dim), q: dim === 2 ? [Math.atan2(pose[3], pose[2])] : pose.slice(dim) }));
  const world = { x: Array(dim).fill(0), q: dim === 2 ? [0] : [1, 0, 0, 0] };
  run.poses = (time) => [...source.bodies.map((_, body) => run.pose(body, time)), ...still, world];
  if (source.measured) {
    const seen = source.measured, table = unpack(seen.poses);
    run.seen = { t: unpackTimes(seen.t), bodies: seen.bodies, at: (j, k) => stored(table, j, k) };
  }
  return run;
}

// ---- the page

function element(parent, tag, attributes = {}, text = "") {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.textContent = text;
  parent.append(made);
  return made;
}

// What views and graph share: the runs, the time, what is shown, colours.
function makeScene(data) {
  const runs = data.runs.map((source) => makeRun(source, data.dim)), root = document.documentElement;
  const theme = root.dataset.theme, dark = window.matchMedia("(prefers-color-scheme: dark)");
  let known = {};
  const scene = {
    ...data, runs, show: new Set(data.show), speed: data.speed,
    first: Math.min(...runs.map((run) => run.first)), last: Math.max(...runs.map((run) => run.last)),
    overlaid: runs.length > 1 && !data.beside, byRun: runs.length > 1 && (!data.beside || runs.every((run) => run.bodies.length === 1)),
    colour: (name) => (known[name] ??= getComputedStyle(root).getPropertyValue(`--${name}`).trim()),
    of: (run, body) => scene.colour(`c${(scene.byRun ? runs.indexOf(run) : body) % 8}`),
    adopt: () => { root.dataset.theme = theme === "auto" ? (dark.matches ? "dark" : "light") : theme; known = {}; },
    // Contacts of a run that are seen now, as [opacity, columns of marks, row].
    marks: (run) => {
      const [t, impact] = run.contacts, seen = [], fade = Math.max(0.4 * scene.speed, 1e-9);
      const k = Math.min(before(run.t, scene.time + 1e-9), run.t.length - 2), from = run.t[k] - 1e-9, to = run.t[k + 1];
      if (!scene.show.has("contacts") || !t.length) return seen;
      for (let row = before(t, Math.min(scene.time - fade, from)); row < t.length && t[row] <= to; row++) {
        const age = scene.time - t[row];
        if (impact[row] ? age >= 0 && age < fade : t[row] >= from) seen.push([impact[row] ? 1 - age / fade : 1, row]);
      }
      return seen;
    },
  };
  scene.time = scene.first;
  dark.addEventListener("change", () => { scene.adopt(); scene.refresh(); });
  scene.adopt();
  return scene;
}

function fitted(canvas) {
  const ratio = window.devicePixelRatio || 1, [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const [w, h] = [Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio))];
  if (canvas.width !== w || canvas.height !== h) Object.assign(canvas, { width: w, height: h });
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  return [pen, width, height];
}

function makeKey(parent, scene) {
  const key = element(parent, "div", { class: "key" }), line = (style, text, kind = "") => {
    const item = element(key, "span");
    element(item, "i", { class: kind }).style.background = style;
    item.append(text);
  };
  key.textContent = "";
  if (scene.overlaid) scene.runs.forEach((run) => line(scene.of(run, 0), run.name));
  else if (scene.runs[0].bodies.length <= 8 && !scene.beside) scene.runs[0].bodies.forEach((name, body) => line(scene.of(scene.runs[0], body), name));
  if (scene.runs.some((run) => run.seen) && scene.show.has("data")) line("none", "measured", "dashed");
  if (scene.unit) element(key, "span", {}, scene.unit);
  return key;
}

function makePlayer(data) {
  const scene = makeScene(data), main = element(document.body, "main", { tabindex: 0, role: "application", "aria-label": `player of a motion. ${HELP}` });
  const stage = element(main, "div", { class: "stage" });
  const names = scene.runs[0].bodies, label = `motion of ${names.length > 6 ? `${names.length} bodies` : names.join(", ")}`;
  const canvas = element(stage, "canvas", { role: "img", "aria-label": label });
  const graph = makeGraph(main, scene), bar = element(main, "div", { class: "bar" });
  const button = element(bar, "button", { type: "button", class: "play", title: HELP }, "▶ Play");
  const scrub = element(bar, "input", { type: "range", min: scene.first, max: scene.last, step: "any", "aria-label": "time" });
  const output = element(bar, "output", { "aria-label": "time" });
  const speed = element(bar, "select", { "aria-label": "speed", title: "speed" });
  for (const value of [...new Set([...SPEEDS, scene.speed])].sort((a, b) => a - b)) element(speed, "option", { value }, `${value} ×`);
  speed.value = scene.speed;
  const digits = Math.min(Math.max(Math.ceil(2 - Math.log10(scene.last - scene.first || 1)), 0), 6);
  let playing = false, since = 0, key = null, loop = true;

  const draw = () => { view.draw(); graph.draw(); };
  const show = (time) => {
    scene.time = Math.min(Math.max(time, scene.first), scene.last);
    scrub.value = scene.time;
    scrub.setAttribute("aria-valuetext", (output.textContent = `${scene.time.toFixed(digits)} s`));
    draw();
  };
  const play = (on) => {
    playing = on;
    button.textContent = on ? "❚❚ Pause" : "▶ Play";
    if (on && scene.time >= scene.last) scene.time = scene.first;
    since = performance.now();
    if (on) requestAnimationFrame(tick);
  };
  function tick(now) {
    if (!playing) return;
    const next = scene.time + (Math.max(now - since, 0) / 1000) * scene.speed;
    since = now;
    show(next > scene.last && loop ? (scene.time < scene.last ? scene.last : scene.first) : next);
    if (next >= scene.last && !loop) play(false); else requestAnimationFrame(tick);
  }
  const move = (frames) => {
    const t = scene.runs[0].t, k = before(t, scene.time + 1e-9), at = t[k] >= scene.time - 1e-9;
    play(false);
    show(t[Math.min(Math.max(k + frames + (at || frames > 0 ? 0 : 1), 0), t.length - 1)]);
  };
  const pace = (by) => { speed.selectedIndex = Math.min(Math.max(speed.selectedIndex + by, 0), speed.length - 1); scene.speed = Number(speed.value); };
  const toggle = (text, on, change) => {
    const made = element(bar, "button", { type: "button", "aria-pressed": on }, text);
    made.addEventListener("click", () => { made.setAttribute("aria-pressed", (on = !on)); change(on); scene.refresh(); });
  };

  toggle("Loop", loop, (on) => { loop = on; });
  for (const [name, text] of Object.entries(TOGGLES)) {
    if (name === "data" && !scene.runs.some((run) => run.seen)) continue;
    toggle(text, scene.show.has(name), (on) => scene.show[on ? "add" : "delete"](name));
  }
  graph.choice(bar);
  element(bar, "button", { type: "button", title: "whole view", "aria-label": "whole view" }, "⤢").addEventListener("click", () => { view.fit(); draw(); });
  scene.refresh = () => { key?.remove(); key = makeKey(stage, scene); view.redye?.(); graph.redo(); draw(); };
  scene.renew = (sources) => { // other motions of the same bodies, over the same times: see explore.js
    scene.runs.forEach((run, r) => Object.assign(run, makeRun(sources[r], scene.dim)));
    view.renew?.();
    scene.refresh();
  };
  window.addEventListener("message", ({ data }) => {
    if (data?.runs) scene.renew(data.runs);
    if (data?.end) scene.seek(scene.last);
  });
  scene.seek = (time) => { play(false); show(time); };
  button.addEventListener("click", () => play(!playing));
  scrub.addEventListener("input", () => scene.seek(Number(scrub.value)));
  speed.addEventListener("change", () => pace(0));
  const keys = {
    " ": () => play(!playing), ArrowRight: () => move(1), ArrowLeft: () => move(-1), ArrowUp: () => pace(1), ArrowDown: () => pace(-1),
    Home: () => scene.seek(scene.first), End: () => scene.seek(scene.last),
    "+": () => view.zoom(1.25), "=": () => view.zoom(1.25), "-": () => view.zoom(0.8), 0: () => { view.fit(); draw(); },
  };
  document.addEventListener("keydown", (event) => {
    const own = event.target.closest("select") || (event.target.closest("button") && (event.key === " " || event.key === "Enter"));
    if (own || event.ctrlKey || event.metaKey || event.altKey || !Object.hasOwn(keys, event.key)) return;
    event.preventDefault();
    keys[event.key]();
  });
  const view = makeView(canvas, scene, draw);
  new ResizeObserver(draw).observe(stage);
  scene.refresh();
  show(scene.first);
  if (window.parent !== window) window.parent.postMessage({ ready: true }, "*"); // to the page it is framed in
  return { scene, view, show, play, isPlaying: () => playing };
}
