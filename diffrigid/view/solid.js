// The motion in 3D, with three.js: shaded solids, orbit controls. z is up.

function makeView(canvas, scene, redraw) {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
  renderer.shadowMap.enabled = true;
  const camera = new THREE.PerspectiveCamera(35, 1, 0.01, 1000);
  camera.up.set(0, 0, 1);
  const controls = new THREE.OrbitControls(camera, canvas), vector = (x) => new THREE.Vector3(...x);
  const cells = scene.beside ? scene.runs.map((run) => [run]) : [scene.runs];
  const { centre, size } = bounds(), fastest = Math.max(...scene.runs.map(topSpeed), 1e-12);
  const hardest = Math.max(...scene.runs.map((run) => Math.max(0, ...run.contacts[2].map((_, row) => Math.hypot(...impulse(run, row))))), 1e-12);
  const stages = cells.map(makeStage);

  function impulse(run, row) { return run.contacts.slice(5).map((column) => column[row]); }
  function topSpeed(run) {
    let top = 0;
    for (let k = 0; k < run.t.length; k++) run.bodies.forEach((_, body) => { top = Math.max(top, Math.hypot(...run.at(body, k).v) || 0); });
    return top;
  }
  function reach({ kind, at, radius, half, points }) {
    const size = { ball: () => radius, capsule: () => radius + half, box: () => Math.hypot(...half), hull: () => Math.max(...points.map((p) => Math.hypot(...p))), plane: () => 0 };
    return Math.hypot(...at) + size[kind]();
  }
  function bounds() {
    const low = [Infinity, Infinity, Infinity], high = low.map((n) => -n);
    for (const run of scene.runs) run.trails.forEach((points, body) => {
      const r = Math.max(0, ...run.shapes.filter((shape) => shape.body === body).map(reach));
      for (const [, ...x] of points) if (x.every(Number.isFinite)) x.forEach((n, i) => { low[i] = Math.min(low[i], n - r); high[i] = Math.max(high[i], n + r); });
    });
    if (!low.every(Number.isFinite)) return { centre: [0, 0, 0], size: 1 };
    return { centre: low.map((n, i) => (n + high[i]) / 2), size: Math.hypot(...high.map((n, i) => n - low[i])) || 1 };
  }

  // ---- things

  function geometry(shape) {
    switch (shape.kind) {
      case "ball": return new THREE.SphereGeometry(shape.radius, 40, 24);
      case "box": return new THREE.BoxGeometry(...shape.half.map((n) => 2 * n));
      case "capsule": return new THREE.CapsuleGeometry(Math.max(shape.radius, 1e-3 * size), 2 * shape.half, 12, 28).rotateZ(-Math.PI / 2);
    }
    const made = new THREE.BufferGeometry(), corners = shape.faces.flatMap((face) => face.flatMap((k) => shape.points[k]));
    made.setAttribute("position", new THREE.Float32BufferAttribute(corners, 3));
    made.computeVertexNormals();
    return made;
  }
  function ballStripes(shape) { // two circles, so that a turn is seen
    const group = new THREE.Group(), turn = Array.from({ length: 65 }, (_, k) => (k * Math.PI) / 32), r = 1.003 * shape.radius;
    for (const circle of [turn.map((a) => [r * Math.cos(a), r * Math.sin(a), 0]), turn.map((a) => [r * Math.cos(a), 0, r * Math.sin(a)])]) group.add(line(circle, "edge"));
    return group;
  }
  function line(points, colour) {
    const shape = new THREE.BufferGeometry();
    shape.setAttribute("position", new THREE.Float32BufferAttribute(points.flat(), 3));
    return new THREE.Line(shape, view.paint(new THREE.LineBasicMaterial(), colour));
  }
  function solid(shape, colour, opacity) {
    const group = new THREE.Group(), form = geometry(shape), clear = opacity < 1;
    const mesh = new THREE.Mesh(form, view.paint(new THREE.MeshStandardMaterial({ roughness: 0.6, transparent: clear, opacity, depthWrite: !clear }), colour));
    mesh.castShadow = !clear; mesh.receiveShadow = !clear;
    group.add(mesh);
    if (shape.kind === "ball") group.add(ballStripes(shape));
    else group.add(new THREE.LineSegments(new THREE.EdgesGeometry(form, 30), view.paint(new THREE.LineBasicMaterial(), clear ? "ghost" : "edge")));
    group.position.set(...shape.at);
    if (shape.turn) group.quaternion.set(shape.turn[1], shape.turn[2], shape.turn[3], shape.turn[0]);
    const holder = new THREE.Group();
    holder.add(group);
    return holder;
  }
  function plane(shape) {
    scene.unit = `grid: ${10 ** Math.floor(Math.log10(size / 2))} m`;
    const width = 12 * size, group = new THREE.Group(), cell = 10 ** Math.floor(Math.log10(size / 2)), lines = [], half = Math.min(Math.ceil(width / 2 / cell), 150);
    const floor = new THREE.Mesh(new THREE.PlaneGeometry(width, width), view.paint(new THREE.MeshStandardMaterial({ roughness: 1, side: THREE.DoubleSide, polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 4 }), "ground"));
    floor.receiveShadow = true;
    const cuts = Array.from({ length: 17 }, (_, n) => ((n - 8) / 8) * half * cell); // short pieces: some renderers lose long lines
    for (let k = -half; k <= half; k++) for (let n = 0; n < 16; n++) lines.push([k * cell, cuts[n], 0], [k * cell, cuts[n + 1], 0], [cuts[n], k * cell, 0], [cuts[n + 1], k * cell, 0]);
    const form = new THREE.BufferGeometry();
    form.setAttribute("position", new THREE.Float32BufferAttribute(lines.flat(), 3));
    const net = new THREE.LineSegments(form, view.paint(new THREE.LineBasicMaterial({ transparent: true, opacity: 0.5 }), "edge"));
    net.position.z = 5e-4 * size;
    group.add(floor, net);
    const normal = vector(shape.normal), turn = new THREE.Quaternion().setFromUnitVectors(new THREE.Vector3(0, 0, 1), normal);
    group.quaternion.copy(turn);
    const foot = vector(centre).sub(normal.clone().multiplyScalar(vector(centre).dot(normal) - shape.offset));
    group.position.copy(foot);
    const holder = new THREE.Group();
    holder.add(group);
    return holder;
  }
  function dye([material, colour]) { material.color.set(typeof colour === "function" ? colour() : scene.colour(colour)); }
  function trailOf(run, body) {
    const points = run.trails[body], made = line(points.map(([, ...x]) => x), () => scene.of(run, body));
    made.frustumCulled = false;
    return made;
  }
  function arrow(colour) {
    const made = new THREE.ArrowHelper(new THREE.Vector3(1, 0, 0), new THREE.Vector3(), 1);
    for (const part of [made.line, made.cone]) {
      Object.assign(view.paint(part.material, colour), { depthTest: false, transparent: true }); // seen through bodies
      part.renderOrder = 1;
    }
    return made;
  }
  function aim(arrow, x, along) {
    const length = Math.hypot(...along);
    arrow.visible = length > 0.01 * size;
    if (!arrow.visible) return;
    arrow.position.set(...x);
    arrow.setDirection(vector(along).divideScalar(length));
    arrow.setLength(length, Math.min(0.03 * size, 0.5 * length), Math.min(0.016 * size, 0.3 * length));
  }
  function pool(stage, make) { // things of which each frame needs another number
    const made = [];
    return { take: (n) => { while (made.length <= n) { made.push(make()); stage.add(made.at(-1)); } return made[n]; }, rest: (n) => made.forEach((thing, k) => { if (k >= n) thing.visible = false; }) };
  }

  function makeStage(runs) {
    const stage = new THREE.Scene(), sun = new THREE.DirectionalLight(0xffffff, 2.2);
    sun.position.set(centre[0] - 0.5 * size, centre[1] - 0.8 * size, centre[2] + 1.6 * size);
    sun.target.position.set(...centre);
    sun.castShadow = true;
    sun.shadow.mapSize.set(2048, 2048);
    sun.shadow.bias = -5e-4; sun.shadow.normalBias = 2e-3 * size;
    Object.assign(sun.shadow.camera, { left: -size, right: size, top: size, bottom: -size, near: 0.1 * size, far: 5 * size });
    stage.add(sun, sun.target, new THREE.HemisphereLight(0xffffff, 0x8f969e, 1.7));
    stage.background = new THREE.Color();
    stage.fog = new THREE.Fog(0, 1, 2); // so that the ground has no edge
    return { whole: stage, stage: new THREE.Group(), runs };
  }
  function fill({ stage, runs }) {
    const parts = runs.map((run, r) => {
      const colour = (body) => () => scene.of(run, body), moving = run.bodies.length;
      const owned = new Set(run.shapes.map((shape) => shape.body));
      const bare = [...run.bodies.keys()].filter((body) => !owned.has(body)).map((body) => ({ body, kind: "ball", at: [0, 0, 0], radius: 0.012 * size }));
      const shapes = [...run.shapes, ...bare].filter((shape) => r === 0 || shape.body < moving).map((shape) => {
        const made = shape.kind === "plane" ? plane(shape) : solid(shape, shape.body < moving ? colour(shape.body) : "ground", 1);
        return { body: shape.body, made };
      });
      const ghosts = (run.seen?.bodies ?? []).map((body) => run.shapes.filter((shape) => shape.body === body).map((shape) => solid(shape, "ghost", 0.35)));
      const joints = run.joints.map(({ ends }) => ({ ends, line: line([[0, 0, 0], [0, 0, 0]], "ink"), dots: ends.map(() => new THREE.Mesh(new THREE.SphereGeometry(0.008 * size, 12, 8), view.paint(new THREE.MeshBasicMaterial(), "ink"))) }));
      const trails = run.bodies.map((_, body) => trailOf(run, body)), arrows = run.bodies.map(() => arrow("ink"));
      stage.add(...shapes.map(({ made }) => made), ...ghosts.flat(), ...joints.flatMap((joint) => [joint.line, ...joint.dots]), ...trails, ...arrows);
      const marks = pool(stage, () => new THREE.Mesh(new THREE.SphereGeometry(0.008 * size, 12, 8), view.paint(new THREE.MeshBasicMaterial({ transparent: true, depthTest: false }), "mark")));
      return { run, shapes, ghosts, joints, trails, arrows, marks, blows: pool(stage, () => arrow("mark")) };
    });
    return parts;
  }

  // ---- one frame

  function put(thing, { x, q }) {
    thing.position.set(...x);
    thing.quaternion.set(q[1], q[2], q[3], q[0]);
  }
  function update({ run, shapes, ghosts, joints, trails, arrows, marks, blows }) {
    const poses = run.poses(scene.time), point = ([body, at]) => {
      const { x, q } = poses[body];
      return vector(at).applyQuaternion(new THREE.Quaternion(q[1], q[2], q[3], q[0])).add(vector(x));
    };
    for (const { body, made } of shapes) { made.visible = Number.isFinite(poses[body].x[0]); put(made, poses[body]); }
    view.drawn[scene.runs.indexOf(run)] = poses.slice(0, run.bodies.length).map(({ x }) => x);
    joints.forEach(({ ends, line, dots }) => {
      const places = ends.map(point);
      places.forEach((place, n) => { dots[n].position.copy(place); line.geometry.attributes.position.setXYZ(n, place.x, place.y, place.z); });
      line.geometry.attributes.position.needsUpdate = true;
      line.frustumCulled = false;
    });
    trails.forEach((trail, body) => {
      trail.visible = scene.show.has("trails");
      trail.geometry.setDrawRange(0, 1 + run.trails[body].findLastIndex(([t]) => t <= scene.time));
    });
    arrows.forEach((made, body) => aim(made, poses[body].x, scene.show.has("velocities") ? poses[body].v.map((n) => (0.2 * size * n) / fastest) : [0, 0, 0]));
    ghosts.forEach((shapes, j) => {
      const { t, at } = run.seen, k = before(t, scene.time), next = Math.min(k + 1, t.length - 1);
      const pose = at(j, scene.time - t[k] > t[next] - scene.time ? next : k), known = [...pose.x, ...pose.q].every(Number.isFinite);
      for (const made of shapes) { made.visible = known && scene.show.has("data"); if (known) put(made, pose); }
    });
    const seen = scene.marks(run);
    seen.forEach(([opacity, row], n) => {
      const x = run.contacts.slice(2, 5).map((column) => column[row]), ball = marks.take(n);
      ball.visible = true; ball.material.opacity = opacity;
      ball.position.set(...x);
      aim(blows.take(n), x, run.contacts[1][row] ? impulse(run, row).map((i) => (0.2 * size * i) / hardest) : [0, 0, 0]);
    });
    marks.rest(seen.length); blows.rest(seen.length);
  }

  function layout(width, height) {
    let best = null;
    for (let columns = 1; columns <= cells.length; columns++) {
      const w = width / columns, h = height / Math.ceil(cells.length / columns), smaller = Math.min(w, h);
      if (!best || smaller > best.smaller) best = { smaller, columns, w, h };
    }
    return best;
  }
  function draw() {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight], grid = layout(width, height), away = camera.position.distanceTo(controls.target);
    if (!width || !height) return;
    renderer.setPixelRatio(window.devicePixelRatio || 1);
    renderer.setSize(width, height, false);
    renderer.setScissorTest(cells.length > 1);
    camera.aspect = grid.w / grid.h;
    camera.updateProjectionMatrix();
    stages.forEach((cell, n) => {
      cell.parts.forEach(update);
      cell.whole.background.set(scene.colour("page"));
      cell.whole.fog.color.set(scene.colour("page"));
      Object.assign(cell.whole.fog, { near: away + 0.8 * size, far: away + 3.5 * size });
      const left = (n % grid.columns) * grid.w, top = Math.floor(n / grid.columns) * grid.h;
      renderer.setViewport(left, height - top - grid.h, grid.w, grid.h);
      renderer.setScissor(left, height - top - grid.h, grid.w, grid.h);
      renderer.render(cell.whole, camera);
    });
    view.screen = (x) => { const p = vector(x).project(camera); return [((p.x + 1) / 2) * grid.w, ((1 - p.y) / 2) * grid.h]; };
    if (scene.beside) names(grid);
  }
  function names(grid) {
    view.labels ??= scene.runs.map((run) => element(canvas.parentNode, "div", { class: "name" }, run.name));
    view.labels.forEach((label, n) => Object.assign(label.style, { left: `${(n % grid.columns) * grid.w + 10}px`, top: `${Math.floor(n / grid.columns) * grid.h + 6}px` }));
  }
  function fit() {
    controls.target.set(...centre);
    camera.near = 0.01 * size; camera.far = 40 * size;
    camera.position.set(centre[0] + 0.5 * size, centre[1] - 1.1 * size, centre[2] + 0.5 * size);
    controls.update();
  }
  const view = {
    draw, fit, drawn: [], paints: [], redye: () => view.paints.forEach(dye),
    paint: (...pair) => { view.paints.push(pair); dye(pair); return pair[0]; },
    zoom: (factor) => { camera.position.sub(controls.target).divideScalar(factor).add(controls.target); controls.update(); redraw(); },
  };
  fit();
  view.renew = () => {
    view.paints = [];
    for (const cell of stages) {
      cell.whole.remove(cell.stage);
      cell.stage.traverse(({ geometry, material }) => { geometry?.dispose(); material?.dispose(); });
      cell.stage = new THREE.Group();
      cell.whole.add(cell.stage);
      cell.parts = fill(cell);
    }
  };
  view.renew();
  controls.addEventListener("change", () => redraw());
  canvas.addEventListener("wheel", (event) => { controls.enableZoom = document.hasFocus() || event.ctrlKey; }, { capture: true, passive: true });
  canvas.addEventListener("dblclick", () => { fit(); redraw(); });
  return view;
}

const able = document.createElement("canvas").getContext("webgl2");
if (!able) element(document.body, "p", {}, "A motion in 3D is drawn with WebGL, which this browser does not have, or not switched on.");
const player = able && makePlayer(JSON.parse(document.getElementById("data").textContent));
