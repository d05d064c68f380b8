// The motion in 2D, on a canvas.

const MARGIN = 28; // [px] around the motion

function makeView(canvas, scene, redraw) {
  const cells = scene.beside ? scene.runs.map((run) => [run]) : [scene.runs];
  const boxes = cells.map((runs) => bounds(runs)), move = { x: 0, y: 0, zoom: 1 };
  const fastest = Math.max(...scene.runs.map((run) => Math.max(...run.trails.map((_, body) => topSpeed(run, body)))), 1e-12);
  const hardest = Math.max(...scene.runs.map((run) => Math.max(0, ...run.contacts[2].map((_, row) => Math.hypot(run.contacts[4][row], run.contacts[5][row])))), 1e-12);

  function topSpeed(run, body) {
    let top = 0;
    for (let k = 0; k < run.t.length; k++) top = Math.max(top, Math.hypot(...run.at(body, k).v) || 0);
    return top;
  }
  function reach({ kind, at, radius, half, points }) {
    const size = { ball: () => radius, capsule: () => radius + half, box: () => Math.hypot(...half), hull: () => Math.max(...points.map((p) => Math.hypot(...p))) };
    return Math.hypot(...at) + size[kind]();
  }

  function bounds(runs) {
    const box = [Infinity, Infinity, -Infinity, -Infinity], add = ([x, y], r) => {
      if (!Number.isFinite(x + y)) return;
      box[0] = Math.min(box[0], x - r); box[1] = Math.min(box[1], y - r); box[2] = Math.max(box[2], x + r); box[3] = Math.max(box[3], y + r);
    };
    for (const run of runs) {
      const still = run.poses(run.first), reaches = still.map(() => 0);
      for (const shape of run.shapes) if (shape.kind !== "plane") reaches[shape.body] = Math.max(reaches[shape.body], reach(shape));
      run.trails.forEach((points, body) => points.forEach(([, ...x]) => add(x, reaches[body])));
      run.shapes.filter((shape) => shape.kind !== "plane" && shape.body >= run.bodies.length).forEach((shape) => add(still[shape.body].x, reaches[shape.body]));
      for (const joint of run.joints) for (const [body, at] of joint.ends) if (body === still.length - 1) add(at, 0);
    }
    return box.every(Number.isFinite) ? box : [-1, -1, 1, 1];
  }

  // Columns and rows that show the cells largest, and pixels per metre.
  function layout(width, height) {
    let best = { scale: 0 };
    for (let columns = 1; columns <= cells.length; columns++) {
      const rows = Math.ceil(cells.length / columns), w = width / columns, h = height / rows;
      const scale = Math.min(...boxes.map((b) => Math.min((w - 2 * MARGIN) / Math.max(b[2] - b[0], 1e-9), (h - 2 * MARGIN) / Math.max(b[3] - b[1], 1e-9))));
      if (scale > best.scale) best = { scale, columns, w, h };
    }
    return best.scale > 0 ? { ...best, scale: best.scale * move.zoom } : { scale: move.zoom, columns: 1, w: width, h: height };
  }

  function draw() {
    const [pen, width, height] = fitted(canvas), grid = layout(width, height);
    pen.lineJoin = pen.lineCap = "round";
    view.grid = grid;
    cells.forEach((runs, n) => {
      const left = (n % grid.columns) * grid.w, top = Math.floor(n / grid.columns) * grid.h, b = boxes[n];
      const centre = [left + grid.w / 2 + move.x, top + grid.h / 2 + move.y], middle = [(b[0] + b[2]) / 2, (b[1] + b[3]) / 2];
      const at = ([x, y]) => [centre[0] + (x - middle[0]) * grid.scale, centre[1] - (y - middle[1]) * grid.scale];
      const back = ([x, y]) => [(x - centre[0]) / grid.scale + middle[0], (centre[1] - y) / grid.scale + middle[1]];
      view.at[n] = at;
      pen.save();
      pen.beginPath(); pen.rect(left, top, grid.w, grid.h); pen.clip();
      drawCell({ pen, at, back, scale: grid.scale, box: [left, top, grid.w, grid.h] }, runs, n);
      pen.restore();
    });
    if (scene.beside) frames(pen, grid);
  }

  function frames(pen, grid) {
    pen.strokeStyle = scene.colour("rule"); pen.fillStyle = scene.colour("ink"); pen.font = "13px system-ui, sans-serif"; pen.lineWidth = 1;
    scene.runs.forEach((run, n) => {
      const left = (n % grid.columns) * grid.w, top = Math.floor(n / grid.columns) * grid.h;
      pen.strokeRect(left + 0.5, top + 0.5, grid.w, grid.h);
      pen.fillText(run.name, left + 10, top + 18);
    });
  }

  function drawCell(canvas, runs, n) {
    gridLines(canvas, n === 0);
    const now = runs.map((run) => run.poses(scene.time));
    runs.forEach((run, r) => { if (r === 0) still(canvas, run, now[r]); });
    if (scene.show.has("trails")) runs.forEach((run) => trails(canvas, run));
    if (scene.show.has("data")) runs.forEach((run) => ghosts(canvas, run));
    runs.forEach((run, r) => bodies(canvas, run, now[r]));
    runs.forEach((run, r) => joints(canvas, run, now[r]));
    if (scene.show.has("velocities")) runs.forEach((run, r) => velocities(canvas, run, now[r]));
    runs.forEach((run) => contacts(canvas, run));
  }

  function gridLines({ pen, at, back, scale, box: [left, top, w, h] }, first) {
    const wanted = 90 / scale, unit = 10 ** Math.floor(Math.log10(wanted)), step = unit * ([5, 2, 1].find((f) => f * unit <= wanted) ?? 1);
    const [x0, y0] = back([left, top + h]), [x1, y1] = back([left + w, top]);
    pen.strokeStyle = scene.colour("grid"); pen.lineWidth = 1;
    pen.beginPath();
    for (let k = Math.ceil(x0 / step); k * step < x1; k++) { const [x] = at([k * step, 0]); pen.moveTo(x, top); pen.lineTo(x, top + h); }
    for (let k = Math.ceil(y0 / step); k * step < y1; k++) { const [, y] = at([0, k * step]); pen.moveTo(left, y); pen.lineTo(left + w, y); }
    pen.stroke();
    if (!first) return;
    view.bar = () => {
      pen.strokeStyle = pen.fillStyle = scene.colour("ink"); pen.lineWidth = 1.5; pen.font = "12px system-ui, sans-serif";
      const y = top + (scene.beside ? 32 : 16), x = left + 12;
      pen.beginPath(); pen.moveTo(x, y - 4); pen.lineTo(x, y); pen.lineTo(x + step * scale, y); pen.lineTo(x + step * scale, y - 4); pen.stroke();
      pen.fillText(step < 0.01 ? `${+(1e3 * step).toPrecision(2)} mm` : step < 1 ? `${+(100 * step).toPrecision(2)} cm` : `${+step.toPrecision(3)} m`, x + step * scale + 8, y + 1);
    };
    view.bar();
  }

  // Path of a shape on a body at pose {x, q}; true if it is closed.
  function trace({ pen, at, scale }, shape, { x: [x, y], q: [angle] }) {
    const turned = (by, [u, v]) => [Math.cos(by) * u - Math.sin(by) * v, Math.sin(by) * u + Math.cos(by) * v];
    const [ox, oy] = turned(angle, shape.at), whole = angle + (shape.turn ? Math.atan2(shape.turn[1], shape.turn[0]) : 0);
    const place = (point) => { const [u, v] = turned(whole, point); return at([x + ox + u, y + oy + v]); }, r = shape.radius * scale;
    pen.beginPath();
    if (shape.kind === "ball") pen.arc(...place([0, 0]), r, 0, 7);
    else if (shape.kind === "capsule") {
      pen.arc(...place([shape.half, 0]), Math.max(r, 0.75), -whole - Math.PI / 2, -whole + Math.PI / 2);
      pen.arc(...place([-shape.half, 0]), Math.max(r, 0.75), -whole + Math.PI / 2, -whole + 1.5 * Math.PI);
    } else {
      const [a, b] = shape.half ?? [], points = shape.points ?? [[-a, -b], [a, -b], [a, b], [-a, b]];
      points.forEach((point, k) => (k ? pen.lineTo(...place(point)) : pen.moveTo(...place(point))));
    }
    pen.closePath();
    return place;
  }

  function still(canvas, run, poses) {
    const { pen, at, back, scale, box } = canvas, far = 2 * Math.hypot(box[2], box[3]) / scale, centre = back([box[0] + box[2] / 2, box[1] + box[3] / 2]);
    pen.fillStyle = scene.colour("ground"); pen.strokeStyle = scene.colour("edge"); pen.lineWidth = 1.5;
    for (const shape of run.shapes.filter((shape) => shape.body >= run.bodies.length)) {
      if (shape.kind !== "plane") { trace(canvas, shape, poses[shape.body]); pen.fill(); pen.stroke(); continue; }
      const { x, q: [angle] } = poses[shape.body], [c, s] = [Math.cos(angle), Math.sin(angle)], [u, v] = shape.normal;
      const n = [c * u - s * v, s * u + c * v], gap = (centre[0] - x[0]) * n[0] + (centre[1] - x[1]) * n[1] - shape.offset;
      const foot = [centre[0] - gap * n[0], centre[1] - gap * n[1]], along = [-n[1] * far, n[0] * far], down = [n[0] * (far + Math.abs(gap)), n[1] * (far + Math.abs(gap))];
      const a = at([foot[0] + along[0], foot[1] + along[1]]), b = at([foot[0] - along[0], foot[1] - along[1]]);
      pen.beginPath(); pen.moveTo(...a); pen.lineTo(...b);
      pen.lineTo(...at([foot[0] - along[0] - down[0], foot[1] - along[1] - down[1]])); pen.lineTo(...at([foot[0] + along[0] - down[0], foot[1] + along[1] - down[1]]));
      pen.fill();
      pen.beginPath(); pen.moveTo(...a); pen.lineTo(...b); pen.stroke();
    }
  }

  function trails({ pen, at }, run) {
    const share = Math.max(20, Math.floor(4000 / run.trails.length)); // points of a trail: the newest, so that many bodies stay fast
    pen.lineWidth = 1.5; pen.globalAlpha = 0.55; pen.lineJoin = "bevel"; // faster
    run.trails.forEach((points, body) => {
      const end = points.findLastIndex(([t]) => t <= scene.time);
      pen.strokeStyle = scene.of(run, body);
      pen.beginPath();
      for (let k = Math.max(0, end - share); k <= end; k++) pen.lineTo(...at(points[k].slice(1)));
      pen.lineTo(...at(run.pose(body, scene.time).x));
      pen.stroke();
    });
    pen.globalAlpha = 1; pen.lineJoin = "round";
  }

  function ghosts(canvas, run) {
    if (!run.seen) return;
    const { pen, at } = canvas, { t, bodies, at: seen } = run.seen, k = before(t, scene.time), next = Math.min(k + 1, t.length - 1);
    const near = scene.time - t[k] > t[next] - scene.time ? next : k, apart = Math.abs(scene.time - t[near]) > (t[t.length - 1] - t[0]) / (t.length - 1);
    bodies.forEach((body, j) => {
      pen.fillStyle = scene.colour("ghost");
      pen.globalAlpha = 0.8;
      for (let row = 0; row <= near; row++) { const { x } = seen(j, row); if (Number.isFinite(x[0] + x[1])) { pen.beginPath(); pen.arc(...at(x), 1.6, 0, 7); pen.fill(); } }
      const pose = seen(j, near);
      if (!apart && Number.isFinite(pose.x[0] + pose.x[1])) ghost(canvas, run, body, pose);
      pen.globalAlpha = 1;
    });
  }

  function ghost(canvas, run, body, pose) {
    const { pen } = canvas, angled = Number.isFinite(pose.q[0]);
    pen.strokeStyle = pen.fillStyle = scene.colour("ghost"); pen.lineWidth = 1.5; pen.setLineDash([4, 4]);
    for (const shape of run.shapes.filter((shape) => shape.body === body && (angled || shape.kind === "ball"))) {
      trace(canvas, shape, angled ? pose : { x: pose.x, q: [0] });
      pen.globalAlpha = 0.22; pen.fill(); pen.globalAlpha = 0.95; pen.stroke();
    }
    pen.setLineDash([]);
  }

  function bodies(canvas, run, poses) {
    const { pen, at, scale } = canvas;
    view.drawn[scene.runs.indexOf(run)] = poses.slice(0, run.bodies.length).map((pose) => at(pose.x));
    pen.lineWidth = 2;
    const bare = new Set(run.bodies.keys());
    for (const shape of run.shapes.filter((shape) => shape.body < run.bodies.length)) {
      bare.delete(shape.body);
      if (!Number.isFinite(poses[shape.body].x[0])) continue;
      pen.fillStyle = pen.strokeStyle = scene.of(run, shape.body);
      const place = trace(canvas, shape, poses[shape.body]);
      pen.globalAlpha = scene.overlaid ? 0.18 : 0.32; pen.fill(); pen.globalAlpha = 1; pen.stroke();
      const size = (shape.radius ?? Math.min(...(shape.half ?? [Infinity]))) * scale;
      if (shape.kind === "ball" && size > 4) { // a spoke shows the turn
        pen.beginPath(); pen.moveTo(...place([0, 0])); pen.lineTo(...place([shape.radius, 0])); pen.stroke();
      }
    }
    for (const body of bare) { pen.fillStyle = scene.of(run, body); pen.beginPath(); pen.arc(...at(poses[body].x), 4, 0, 7); pen.fill(); }
  }

  function joints({ pen, at }, run, poses) {
    const point = ([body, [u, v]]) => { const { x, q: [a] } = poses[body]; return at([x[0] + Math.cos(a) * u - Math.sin(a) * v, x[1] + Math.sin(a) * u + Math.cos(a) * v]); };
    pen.strokeStyle = scene.colour("ink"); pen.lineWidth = 1.5;
    for (const { kind, ends } of run.joints) {
      const [a, b] = ends.map(point), [dx, dy] = [b[0] - a[0], b[1] - a[1]];
      pen.fillStyle = scene.colour("page");
      if (kind === "rod" || kind === "spring" || kind === "prismatic") {
        pen.beginPath(); pen.moveTo(...a);
        if (kind === "spring") for (let k = 1; k < 12; k++) { const side = k % 2 ? 0.5 : -0.5, n = Math.hypot(dx, dy) || 1; pen.lineTo(a[0] + (dx * k) / 12 - (dy * side * 12) / n, a[1] + (dy * k) / 12 + (dx * side * 12) / n); }
        pen.lineTo(...b); pen.stroke();
      }
      for (const [x, y] of kind === "revolute" || kind === "ball" || kind === "weld" ? [a] : [a, b]) {
        pen.beginPath();
        if (kind === "weld" || kind === "prismatic") pen.rect(x - 4, y - 4, 8, 8); else pen.arc(x, y, kind === "spring" ? 2.5 : 4, 0, 7);
        pen.fill(); pen.stroke();
      }
    }
  }

  function arrow(pen, [x, y], [dx, dy]) {
    const length = Math.hypot(dx, dy), head = Math.min(8, 0.5 * length);
    if (length < 2) return;
    const [u, v] = [dx / length, dy / length], tip = [x + dx, y + dy], neck = [tip[0] - head * u, tip[1] - head * v];
    pen.beginPath(); pen.moveTo(x, y); pen.lineTo(...neck); pen.stroke();
    pen.beginPath(); pen.moveTo(...tip); pen.lineTo(neck[0] - 0.45 * head * v, neck[1] + 0.45 * head * u); pen.lineTo(neck[0] + 0.45 * head * v, neck[1] - 0.45 * head * u); pen.fill();
  }

  function velocities({ pen, at }, run, poses) {
    pen.strokeStyle = pen.fillStyle = scene.colour("ink"); pen.lineWidth = 1.8;
    for (const { x, v } of poses.slice(0, run.bodies.length)) if (Number.isFinite(x[0])) arrow(pen, at(x), v.map((n, i) => ((i ? -64 : 64) * n) / fastest));
  }

  function contacts({ pen, at }, run) {
    const [, impact, px, py, ix, iy] = run.contacts;
    pen.strokeStyle = pen.fillStyle = scene.colour("mark"); pen.font = "12px system-ui, sans-serif"; pen.lineWidth = 2;
    const seen = scene.marks(run), few = seen.length <= 12;
    for (const [opacity, row] of seen) {
      const [x, y] = at([px[row], py[row]]), size = Math.hypot(ix[row], iy[row]);
      pen.globalAlpha = opacity;
      pen.beginPath(); pen.arc(x, y, impact[row] ? 3 : 2.4, 0, 7); pen.fill();
      if (!impact[row]) continue;
      pen.beginPath(); pen.arc(x, y, 5 + 10 * (1 - opacity), 0, 7); pen.stroke();
      arrow(pen, [x, y], [(64 * ix[row]) / hardest, (-64 * iy[row]) / hardest]);
      if (few && size > 0.02 * hardest) pen.fillText(`${size >= 1e3 || size < 1e-3 ? +size.toPrecision(3) : size.toPrecision(3)} N s`, x + 12, y - 8);
    }
    pen.globalAlpha = 1;
  }

  // ---- pan and zoom

  function zoom(factor, [x, y] = [canvas.clientWidth / 2, canvas.clientHeight / 2]) {
    const { w, h } = view.grid, [cx, cy] = [(x % w) - w / 2, (y % h) - h / 2];
    move.x = cx - (cx - move.x) * factor; move.y = cy - (cy - move.y) * factor; move.zoom *= factor;
    redraw();
  }
  const touches = new Map(), place = (event) => [event.offsetX, event.offsetY];
  canvas.addEventListener("wheel", (event) => {
    if (!document.hasFocus() && !event.ctrlKey) return; // else a page could not be scrolled past a player
    event.preventDefault();
    zoom(Math.exp(-0.0015 * event.deltaY), place(event));
  }, { passive: false });
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); touches.set(event.pointerId, place(event)); });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => touches.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const from = touches.get(event.pointerId), to = place(event);
    if (!from) return;
    touches.set(event.pointerId, to);
    if (touches.size === 1) { move.x += to[0] - from[0]; move.y += to[1] - from[1]; redraw(); return; }
    const other = [...touches].find(([id]) => id !== event.pointerId)[1], size = ([x, y]) => Math.hypot(x - other[0], y - other[1]);
    zoom(size(to) / Math.max(size(from), 1), other);
  });
  canvas.addEventListener("dblclick", () => { view.fit(); redraw(); });
  const view = { draw, zoom, at: [], drawn: [], fit: () => Object.assign(move, { x: 0, y: 0, zoom: 1 }) };
  return view;
}

const player = makePlayer(JSON.parse(document.getElementById("data").textContent));
