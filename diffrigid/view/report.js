"use strict";
// A player for every figure.player: outlines of the fitted motion over filled shapes of the measured poses.

const SPEEDS = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2];
const MARGIN = 24; // [px] around the motion

function element(parent, tag, attributes = {}, text = "") {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.textContent = text;
  parent.append(made);
  return made;
}

function bounds(data) {
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  for (const body of data.bodies) {
    const reach = Math.max(...body.outline.map(([x, y]) => Math.hypot(x, y)));
    for (const [x, y] of body.fit) {
      box[0] = Math.min(box[0], x - reach); box[1] = Math.min(box[1], y - reach);
      box[2] = Math.max(box[2], x + reach); box[3] = Math.max(box[3], y + reach);
    }
  }
  return box;
}

// Pose at time t, on the straight line between its neighbours.
function between(times, poses, t) {
  let k = 1;
  while (k < times.length - 1 && times[k] < t) k++;
  const share = Math.min(Math.max((t - times[k - 1]) / (times[k] - times[k - 1]), 0), 1);
  return poses[k].map((value, i) => (1 - share) * poses[k - 1][i] + share * value);
}

function nearest(times, t) {
  let best = 0;
  for (let k = 1; k < times.length; k++) if (Math.abs(times[k] - t) < Math.abs(times[best] - t)) best = k;
  return best;
}

function scaleBar(pixels) {
  const wanted = 110 / pixels, unit = 10 ** Math.floor(Math.log10(wanted));
  const length = unit * [5, 2, 1].find((factor) => factor * unit <= wanted);
  return [length, length < 0.01 ? `${+(1e3 * length).toPrecision(1)} mm` : length < 1 ? `${+(100 * length).toPrecision(1)} cm` : `${length} m`];
}

function makePlayer(figure) {
  const data = JSON.parse(figure.querySelector("script").textContent);
  const last = data.t[data.t.length - 1], step = data.t_measured[1] - data.t_measured[0];
  const canvas = element(figure, "canvas"), bar = element(figure, "div", { class: "bar" });
  const button = element(bar, "button", { type: "button" }, "Play");
  const scrub = element(bar, "input", { type: "range", min: 0, max: last, step: "any", value: 0, "aria-label": "time" });
  const output = element(bar, "output");
  const speed = element(bar, "select", { "aria-label": "speed" });
  for (const value of SPEEDS) element(speed, "option", { value }, `${value} × real time`);
  speed.value = data.speed;
  const key = element(figure, "div", { class: "key" });
  for (const [name, text] of [["fit", "fitted"], ["ghost", "measured"]]) {
    const item = element(key, "span");
    element(item, "i", { class: name });
    item.append(text);
  }
  element(key, "span", {}, "space: play or pause, arrows: one frame, home and end");
  figure.tabIndex = 0;
  const box = bounds(data);
  let time = 0, playing = false, before = 0;

  function draw() {
    const width = canvas.clientWidth, ratio = window.devicePixelRatio || 1;
    const pixels = (width - 2 * MARGIN) / (box[2] - box[0]);
    const height = Math.round((box[3] - box[1]) * pixels + 2 * MARGIN);
    canvas.style.height = `${height}px`;
    canvas.width = width * ratio; canvas.height = height * ratio;
    const pen = canvas.getContext("2d"), style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name).trim();
    const at = ([x, y]) => [MARGIN + (x - box[0]) * pixels, height - MARGIN - (y - box[1]) * pixels];
    pen.scale(ratio, ratio);
    pen.lineJoin = "round";

    function trace(points) {
      pen.beginPath();
      points.forEach((point, k) => (k ? pen.lineTo(...at(point)) : pen.moveTo(...at(point))));
    }
    function shape(outline, [x, y, angle]) {
      const c = Math.cos(angle), s = Math.sin(angle);
      trace(outline.map(([u, v]) => [x + c * u - s * v, y + s * u + c * v]));
    }

    const seen = nearest(data.t_measured, time);
    pen.fillStyle = colour("--ghost");
    for (const body of data.bodies) {
      if (!body.measured[seen]) continue;
      shape(body.outline, body.measured[seen]);
      pen.fill();
    }
    pen.fillStyle = colour("--measured");
    for (const body of data.bodies) {
      for (const pose of body.measured.slice(0, seen + 1)) {
        if (!pose) continue;
        pen.beginPath(); pen.arc(...at(pose), 1.3, 0, 7); pen.fill();
      }
    }
    pen.strokeStyle = colour("--soft"); pen.lineWidth = 1;
    for (const line of data.lines) { trace(line); pen.stroke(); }
    pen.strokeStyle = colour("--fit"); pen.lineWidth = 1.6;
    for (const body of data.bodies) { shape(body.outline, between(data.t, body.fit, time)); pen.stroke(); }

    const [length, label] = scaleBar(pixels);
    pen.strokeStyle = pen.fillStyle = colour("--soft"); pen.lineWidth = 2;
    pen.beginPath(); pen.moveTo(MARGIN, 14); pen.lineTo(MARGIN + length * pixels, 14); pen.stroke();
    pen.font = "12px system-ui, sans-serif"; pen.fillText(label, MARGIN + length * pixels + 8, 18);
    output.textContent = last < 1 ? `${(1e3 * time).toFixed(0)} ms` : `${time.toFixed(2)} s`;
  }

  function show(value) {
    time = Math.min(Math.max(value, 0), last);
    scrub.value = time;
    draw();
  }
  function tick(now) {
    if (!playing) return;
    const next = time + ((now - before) / 1000) * Number(speed.value);
    before = now;
    show(time >= last ? 0 : next);
    requestAnimationFrame(tick);
  }
  function play(on) {
    playing = on;
    button.textContent = on ? "Pause" : "Play";
    before = performance.now();
    if (on) requestAnimationFrame(tick);
  }
  button.addEventListener("click", () => play(!playing));
  scrub.addEventListener("input", () => { play(false); show(Number(scrub.value)); });
  window.addEventListener("resize", draw);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  draw();
  return { figure, play, toggle: () => play(!playing), move: (frames) => { play(false); show(time + frames * step); }, show, last };
}

const players = [...document.querySelectorAll("figure.player")].map(makePlayer);
let current = players[0];
for (const player of players) {
  for (const event of ["pointerenter", "focusin"]) player.figure.addEventListener(event, () => { current = player; });
}
document.addEventListener("keydown", (event) => {
  const inside = event.target.closest("select, summary, a") || event.ctrlKey || event.metaKey || event.altKey;
  const keys = {
    " ": () => current.toggle(), ArrowRight: () => current.move(1), ArrowLeft: () => current.move(-1),
    Home: () => { current.play(false); current.show(0); }, End: () => { current.play(false); current.show(current.last); },
  };
  if (!current || inside || !keys[event.key]) return;
  if (event.key === " " && (event.repeat || event.target.closest("button"))) return; // a button presses itself
  if ((event.key === "Home" || event.key === "End") && !event.target.closest("figure.player")) return; // these scroll the page
  event.preventDefault();
  keys[event.key]();
});
