// The graph of a player: energy or a coordinate over time, with the time as a line.

const COORDINATES = { 2: ["x", "y", "angle", "vx", "vy"], 3: ["x", "y", "z", "", "", "", "", "vx", "vy", "vz"] };
const UNITS = { energy: "J", speed: "m/s", angle: "rad", x: "m", y: "m", z: "m", vx: "m/s", vy: "m/s", vz: "m/s" };

function makeGraph(parent, scene) {
  const box = element(parent, "div", { class: "graph" });
  const canvas = element(box, "canvas", { role: "img", "aria-label": "graph over time; click to go there" });
  const names = COORDINATES[scene.dim].filter(Boolean), left = 52, right = 12, top = 16, bottom = 16;
  let chosen = scene.plot, picture = null, across = (t) => t;

  const value = (name, { x, q, v }) => (name === "speed" ? Math.hypot(...v) : [...x, ...q, ...v][COORDINATES[scene.dim].indexOf(name)]);
  function lines() {
    if (chosen === "energy") return scene.runs.flatMap((run, r) => run.energy.map((y, kind) => ({
      t: run.t, y, colour: scene.overlaid ? scene.colour(`c${r % 8}`) : scene.colour(["c0", "c2", "ink"][kind]), dash: scene.overlaid ? [[1, 3], [5, 3], []][kind] : [],
      name: r ? "" : ["kinetic", "potential", "total"][kind],
    })));
    return scene.runs.flatMap((run) => run.bodies.map((name, body) => ({
      t: run.t, y: Float64Array.from(run.t, (_, k) => value(chosen, run.at(body, k))), colour: scene.of(run, body), dash: [], name: "",
    })).concat(!run.seen || !scene.show.has("data") ? [] : run.seen.bodies.map((body, j) => ({
      t: run.seen.t, y: Float64Array.from(run.seen.t, (_, k) => value(chosen, run.seen.at(j, k))), colour: scene.overlaid ? scene.colour("ghost") : scene.of(run, body), dots: true, name: "",
    }))));
  }
  function paint(pen, width, height) {
    const all = lines(), known = all.flatMap((line) => [...line.y].filter(Number.isFinite));
    let low = known.reduce((a, b) => Math.min(a, b), Infinity), high = known.reduce((a, b) => Math.max(a, b), -Infinity);
    if (!known.length) [low, high] = [0, 1];
    const pad = 0.06 * (high - low) || 0.5 * Math.abs(high) || 1, span = scene.last - scene.first || 1;
    low -= pad; high += pad;
    across = (t) => left + ((width - left - right) * (t - scene.first)) / span;
    const up = (y) => height - bottom - ((height - top - bottom) * (y - low)) / (high - low);
    pen.font = "11px system-ui, sans-serif"; pen.lineWidth = 1; pen.lineJoin = "round";
    const unit = 10 ** Math.floor(Math.log10((high - low) / 2)), step = [5, 2, 1].map((f) => f * unit).find((s) => (high - low) / s >= 2) ?? unit;
    for (let n = Math.ceil(low / step); n * step <= high; n++) {
      pen.strokeStyle = scene.colour(n === 0 ? "rule" : "grid"); pen.fillStyle = scene.colour("soft"); pen.textAlign = "right";
      pen.beginPath(); pen.moveTo(left, up(n * step)); pen.lineTo(width - right, up(n * step)); pen.stroke();
      pen.fillText(`${+(n * step).toPrecision(6)}`, left - 6, up(n * step) + 4);
    }
    pen.textAlign = "left"; pen.fillStyle = scene.colour("ink"); pen.fillText(`${chosen} [${UNITS[chosen]}]`, left, 11);
    let at = left + 90;
    for (const line of all) {
      pen.strokeStyle = pen.fillStyle = line.colour; pen.lineWidth = 1.6; pen.setLineDash(line.dash ?? []);
      if (line.name) { pen.fillText(line.name, at, 11); at += pen.measureText(line.name).width + 14; }
      let pending = true;
      pen.beginPath();
      line.t.forEach((t, k) => {
        if (!Number.isFinite(line.y[k])) { pending = true; return; }
        if (line.dots) { pen.globalAlpha = 0.5; pen.fillRect(across(t) - 1.2, up(line.y[k]) - 1.2, 2.4, 2.4); pen.globalAlpha = 1; return; }
        pen[pending ? "moveTo" : "lineTo"](across(t), up(line.y[k])); pending = false;
      });
      pen.stroke();
    }
    pen.setLineDash([]); pen.fillStyle = scene.colour("mark");
    if (scene.show.has("contacts")) for (const run of scene.runs) run.contacts[0].forEach((t, row) => {
      if (run.contacts[1][row]) { pen.beginPath(); pen.moveTo(across(t), height - bottom); pen.lineTo(across(t) - 3, height - bottom + 6); pen.lineTo(across(t) + 3, height - bottom + 6); pen.fill(); }
    });
  }
  function draw() {
    if (!chosen) return;
    const [pen, width, height] = fitted(canvas), size = `${canvas.width} ${canvas.height}`;
    if (picture?.size !== size) {
      const copy = document.createElement("canvas");
      copy.width = canvas.width; copy.height = canvas.height;
      paint(pen, width, height);
      copy.getContext("2d").drawImage(canvas, 0, 0);
      picture = { size, copy };
    } else pen.drawImage(picture.copy, 0, 0, width, height);
    const x = across(scene.time);
    pen.strokeStyle = scene.colour("ink"); pen.lineWidth = 1;
    pen.beginPath(); pen.moveTo(x, top); pen.lineTo(x, height - bottom); pen.stroke();
  }
  const seek = (event) => {
    const { left: edge, width } = canvas.getBoundingClientRect();
    scene.seek(scene.first + ((event.clientX - edge - left) / (width - left - right)) * (scene.last - scene.first));
  };
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); seek(event); });
  canvas.addEventListener("pointermove", (event) => { if (event.buttons) seek(event); });
  const choice = (bar) => {
    const select = element(bar, "select", { "aria-label": "graph", title: "graph" });
    for (const name of ["energy", "speed", ...names, ""]) element(select, "option", { value: name }, name || "no graph");
    select.value = chosen;
    select.addEventListener("change", () => { chosen = select.value; scene.refresh(); });
  };
  return { draw, choice, redo: () => { picture = null; box.style.display = chosen ? "" : "none"; } };
}
