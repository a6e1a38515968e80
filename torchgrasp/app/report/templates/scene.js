// The 3D scene: layers of shapes, a camera, and their motion. cloud.js reads files, panel.js makes the panel beside it.
// Errors are shown on the page, so that users and tests see them without a console.
const panel = document.getElementById("panel"), stage = document.getElementById("stage");
const errors = add(panel, "pre", { id: "errors" });
window.onerror = (message) => { errors.textContent += message + "\n"; };
const own = console.error;
console.error = (...words) => { errors.textContent += words.join(" ") + "\n"; own(...words); };

const run = JSON.parse(document.getElementById("data").textContent);
const KINDS = { f4: Float32Array, u4: Uint32Array, u1: Uint8Array };

/* The text of an element is never read as HTML. */
function add(parent, tag, values = {}, text = null) {
  const element = Object.assign(document.createElement(tag), values);
  if (text !== null) element.textContent = text;
  return parent.appendChild(element);
}

function unpack(buffer) {
  const bytes = Uint8Array.from(atob(buffer.data), (letter) => letter.charCodeAt(0));
  return new KINDS[buffer.kind](bytes.buffer);
}

function geometry(part) {
  const shape = new THREE.BufferGeometry();
  shape.setAttribute("position", new THREE.BufferAttribute(unpack(part.points), 3));
  if (part.faces) shape.setIndex(new THREE.BufferAttribute(unpack(part.faces), 1));
  if (part.normals) shape.setAttribute("normal", new THREE.BufferAttribute(unpack(part.normals), 3));
  if (part.colors) shape.setAttribute("color", new THREE.BufferAttribute(unpack(part.colors), 3, true));
  return shape;
}

function lit(values) {
  return new THREE.MeshPhongMaterial({ shininess: 25, specular: 0x222222, side: THREE.DoubleSide, ...values });
}

/* A solid throws a shadow on the table. */
function solid(shape, values) {
  return Object.assign(new THREE.Mesh(shape, lit(values)), { castShadow: true });
}

function lines(points, color) {
  return new THREE.LineSegments(new THREE.BufferGeometry().setFromPoints(points), new THREE.LineBasicMaterial({ color }));
}

// One group of shapes for each layer.
const scene = new THREE.Scene(), layers = {};
scene.background = new THREE.Color("#fcfcfa");
function layer(name) {
  if (!layers[name]) scene.add(layers[name] = new THREE.Group());
  return layers[name];
}

function dots(shape, color) {
  return new THREE.Points(shape, new THREE.PointsMaterial({ color, size: 2.5 * window.devicePixelRatio, sizeAttenuation: false }));
}
layer("cloud").add(dots(geometry({ points: run.cloud }), "#c2452d"));
if (run.others) layer("other objects").add(dots(geometry({ points: run.others }), "#8b929c"));

const surface = geometry(run.surface), shell = geometry(run.surface);
layer("surface").add(solid(surface, { vertexColors: true }));

// The shell is drawn twice: first its depth alone, then its colour where it is nearest. So folds do not show through.
// No object reaches below the table.
const above = run.table ? [new THREE.Plane(new THREE.Vector3(0, 0, 1), 0)] : [];
const veil = { side: THREE.FrontSide, clippingPlanes: above };
layer("shell").add(
  Object.assign(new THREE.Mesh(shell, new THREE.MeshBasicMaterial({ ...veil, colorWrite: false })), { renderOrder: 1 }),
  Object.assign(new THREE.Mesh(shell, lit({ ...veil, vertexColors: true, transparent: true, opacity: 0.4 })), { renderOrder: 2 }));
const deviations = unpack(run.surface.std);

/* Move each vertex outward by `sigma` standard deviations, less where faces would fold: there opposite sides meet. */
let inflated = 0;
function inflate(sigma) {
  if (sigma === inflated) return;
  inflated = sigma;
  const from = surface.attributes.position.array, to = shell.attributes.position.array, out = surface.attributes.normal.array;
  const faces = surface.index.array, reach = deviations.map((std) => sigma * std), folded = new Uint8Array(reach.length);
  for (let round = 0; round < 40; round++) {
    for (let i = 0; i < to.length; i++) to[i] = from[i] + reach[Math.floor(i / 3)] * out[i];
    folded.fill(0);
    for (let f = 0; f < faces.length; f += 3) {
      if (bend(from, to, faces[f], faces[f + 1], faces[f + 2]) < 0.1) folded[faces[f]] = folded[faces[f + 1]] = folded[faces[f + 2]] = 1;
    }
    if (!folded.includes(1)) break;
    const sum = new Float32Array(reach.length), near = new Float32Array(reach.length);
    for (let f = 0; f < faces.length; f += 3) {
      for (let k = 0; k < 3; k++) { sum[faces[f + k]] += reach[faces[f + (k + 1) % 3]]; near[faces[f + k]]++; }
    }
    folded.forEach((is, vertex) => { if (is) reach[vertex] = 0.9 * Math.min(reach[vertex], sum[vertex] / near[vertex]); });
  }
  shell.attributes.position.needsUpdate = true;
  shell.computeVertexNormals();
}
/* The cosine of the angle by which a face (a, b, c) turns between two lists of positions. */
function bend(from, to, a, b, c) {
  const [x, y, z] = turn(from, 3 * a, 3 * b, 3 * c), [u, v, w] = turn(to, 3 * a, 3 * b, 3 * c);
  return (x * u + y * v + z * w) / (Math.hypot(x, y, z) * Math.hypot(u, v, w) || 1e-30);
}
function turn(p, a, b, c) {
  const x = p[b] - p[a], y = p[b + 1] - p[a + 1], z = p[b + 2] - p[a + 2], u = p[c] - p[a], v = p[c + 1] - p[a + 1], w = p[c + 2] - p[a + 2];
  return [y * w - z * v, z * u - x * w, x * v - y * u];
}

const pieces = run.hand.map((piece) => {
  const mesh = solid(geometry(piece), { color: piece.color });
  mesh.matrixAutoUpdate = false;
  mesh.userData.link = piece.link;
  layer("hand").add(mesh);
  return mesh;
});

/* Matrices are stored row by row; `frame` is the index of a posture or of a tick. */
function pose(links, shape, frame) {
  const count = shape[shape.length - 3];
  for (const mesh of pieces) place(mesh, links, frame * count + mesh.userData.link);
}
function place(mesh, matrices, index) {
  mesh.matrix.fromArray(matrices, 16 * index).transpose();
  mesh.matrixWorldNeedsUpdate = true;
}

/* Between two frames links turn about their own axes; `rise` [m] lifts them all. */
function blend(links, shape, frame, share, rise) {
  const count = shape[shape.length - 3], parts = () => [new THREE.Vector3(), new THREE.Quaternion(), new THREE.Vector3()];
  for (const mesh of pieces) {
    const [begin, end] = [frame, frame + 1].map((k) => {
      const found = parts();
      new THREE.Matrix4().fromArray(links, 16 * (k * count + mesh.userData.link)).transpose().decompose(...found);
      return found;
    });
    begin[0].lerp(end[0], share).z += rise;
    mesh.matrix.compose(begin[0], begin[1].slerp(end[1], share), begin[2]);
    mesh.matrixWorldNeedsUpdate = true;
  }
}

const ARROW = 0.035; // [m], longer than a fingertip is wide
const shaft = new THREE.CylinderGeometry(0.0012, 0.0012, 1, 10).translate(0, 0.5, 0);
const tip = new THREE.ConeGeometry(0.0035, 0.011, 14);
const ball = new THREE.SphereGeometry(0.0045, 20, 14);
function newArrow(color) {
  const arrow = new THREE.Group();
  for (const part of [shaft, tip, ball]) arrow.add(new THREE.Mesh(part, lit({ color })));
  return arrow;
}
/* The arrow begins with its ball at a point and is `vector` long; it is hidden where one of both is not a number. */
function aim(arrow, point, vector) {
  const length = vector.length();
  arrow.visible = Number.isFinite(length + point.length());
  if (!arrow.visible) return;
  arrow.position.copy(point);
  arrow.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), vector.clone().normalize());
  arrow.children[0].scale.y = Math.max(length, 1e-6);
  arrow.children[1].position.y = length;
}
const arrows = run.fingers.map(([, color]) => layer("contacts").add(newArrow(color)).children.slice(-1)[0]);
const contacts = { points: unpack(run.grasps.points), normals: unpack(run.grasps.normals) };
const postures = unpack(run.grasps.links);

function touch(grasp, rise) {
  arrows.forEach((arrow, finger) => {
    const at = 3 * (grasp * arrows.length + finger), point = new THREE.Vector3().fromArray(contacts.points, at);
    point.z += rise;
    aim(arrow, point, new THREE.Vector3().fromArray(contacts.normals, at).multiplyScalar(ARROW));
  });
}
/* In the simulation the arrows are the forces on the fingertips. */
function press(frame) {
  arrows.forEach((arrow, finger) => {
    const at = 3 * (frame * arrows.length + finger);
    const force = new THREE.Vector3().fromArray(replay.pushes, at).multiplyScalar(-0.01); // 1 cm for each newton
    aim(arrow, new THREE.Vector3().fromArray(replay.touches, at), force);
  });
}

const replay = run.replay && Object.fromEntries(["ticks", "object", "links", "time", "forces", "touches", "pushes"].map(
  (name) => [name, unpack(run.replay[name])]));
let truth = null;
if (replay) {
  truth = solid(geometry(run.replay), { color: run.object, flatShading: true });
  truth.matrixAutoUpdate = false;
  layer("true object").add(truth);
}

// The first view shows the object before and after the lift, the hand at the first grasp, and the table.
const count = run.grasps.rows.length;
surface.computeBoundingBox();
const bounds = surface.boundingBox.clone(), LIFT = 0.1; // [m], as simulated
if (count) {
  pose(postures, run.grasps.links.shape, 2);
  scene.updateMatrixWorld(true);
  bounds.union(new THREE.Box3().setFromObject(layers.hand));
  bounds.max.z += LIFT;
}
const sphere = bounds.getBoundingSphere(new THREE.Sphere());
const middle = surface.boundingBox.getCenter(new THREE.Vector3());
if (run.table) {
  const radius = 1.3 * sphere.radius, CELL = 0.05; // [m]
  const behind = run.edge ? [new THREE.Plane(new THREE.Vector3(...run.edge.slice(0, 3)).negate(), run.edge[3])] : [];
  const disc = new THREE.CircleGeometry(radius, 96), grid = [];
  const top = new THREE.Mesh(disc, new THREE.MeshBasicMaterial({ color: run.table, side: THREE.DoubleSide, clippingPlanes: behind }));
  const shade = new THREE.Mesh(disc, new THREE.ShadowMaterial({ opacity: 0.25, clippingPlanes: behind }));
  shade.receiveShadow = true;
  for (let k = -Math.floor(radius / CELL); k <= radius / CELL; k++) {
    const half = Math.sqrt(radius ** 2 - (k * CELL) ** 2);
    grid.push(...[[k * CELL, -half], [k * CELL, half], [-half, k * CELL], [half, k * CELL]].map((p) => new THREE.Vector3(...p, 0)));
  }
  const net = lines(grid, "#d3d0c6");
  net.material.clippingPlanes = behind;
  // A hair apart, so that none of them flickers through another.
  [top, net, shade].forEach((part, k) => part.position.set(middle.x, middle.y, -0.0015 + 0.0005 * k));
  layer("table").add(top, net, shade);
}

/* The frame of the cloud's file, and of all poses of a grasp. */
const frame = new THREE.Group(), AXES = { x: "#d62728", y: "#2ca02c", z: "#1f4fd8" };
frame.applyMatrix4(new THREE.Matrix4().fromArray(run.frame.flat()).transpose());
Object.entries(AXES).forEach(([name, color], k) => {
  const along = new THREE.Vector3().setComponent(k, 0.06), arrow = newArrow(color), canvas = document.createElement("canvas");
  aim(arrow, new THREE.Vector3(), along);
  Object.assign(canvas, { width: 64, height: 64 });
  const pen = Object.assign(canvas.getContext("2d"), { font: "bold 48px sans-serif", fillStyle: color, textAlign: "center" });
  pen.fillText(name, 32, 48);
  const letter = new THREE.Sprite(new THREE.SpriteMaterial({ map: new THREE.CanvasTexture(canvas), alphaTest: 0.4 }));
  letter.position.copy(along).multiplyScalar(1.25);
  letter.center.set(0.5, 0.15); // it stands on the table
  letter.scale.setScalar(0.018);
  frame.add(arrow, letter);
});
layer("axes").add(frame);

/* A pyramid at each sensor, and its line of sight to the cloud. */
for (const position of run.sensors) {
  const eye = new THREE.Vector3(...position), to = middle.clone().sub(eye), far = 0.05; // [m]
  const forward = to.clone().normalize(), up = new THREE.Vector3(0, 0, 1), right = forward.clone().cross(up);
  if (right.length() < 1e-6) right.set(1, 0, 0);
  right.normalize();
  up.crossVectors(right, forward);
  const rim = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) => eye.clone().addScaledVector(forward, far)
    .addScaledVector(right, 0.6 * far * x).addScaledVector(up, 0.45 * far * y));
  const sight = lines([eye, eye.clone().add(to)], "#c2452d");
  Object.assign(sight.material, { transparent: true, opacity: 0.35 });
  layer("camera").add(lines(rim.flatMap((corner, k) => [eye, corner, corner, rim[(k + 1) % 4]]), "#22262b"), sight);
}

const camera = new THREE.PerspectiveCamera(30, 1, sphere.radius / 50, 60 * sphere.radius);
camera.up.set(0, 0, 1);
scene.add(camera, new THREE.AmbientLight(0xffffff, 0.55));
for (const [x, y, z, strength] of [[-0.5, 0.7, 0.6, 0.5], [0.7, 0.1, 0.6, 0.25]]) {
  const lamp = new THREE.DirectionalLight(0xffffff, strength);
  lamp.position.set(x, y, z); // fixed to the camera, whose target is its own centre
  camera.add(lamp, lamp.target);
}
const sun = new THREE.DirectionalLight(0xffffff, 0); // it lights nothing: it throws the shadow, nearly straight down
sun.position.copy(middle).add(new THREE.Vector3(0.1, 0.15, 1).multiplyScalar(3 * sphere.radius));
sun.target.position.copy(middle);
sun.castShadow = true;
Object.assign(sun.shadow.camera, { left: -2 * sphere.radius, right: 2 * sphere.radius, top: 2 * sphere.radius,
  bottom: -2 * sphere.radius, near: sphere.radius / 10, far: 6 * sphere.radius });
sun.shadow.mapSize.set(1024, 1024);
scene.add(sun, sun.target);

let renderer = null, controls = null;
try {
  // Headless browsers take pictures between two frames, so the last frame is kept.
  renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
  renderer.localClippingEnabled = renderer.shadowMap.enabled = true;
} catch (failure) {
  add(stage, "p", { id: "nothing" }, "This browser has no WebGL, which the 3D view needs. The report beside this page has pictures.");
}
function draw() { if (renderer) renderer.render(scene, camera); }
/* Show a ball around a centre, from the first direction. */
function look(center, radius) {
  const narrow = Math.min(1, stage.clientWidth / stage.clientHeight);
  camera.position.fromArray(run.eye).multiplyScalar(radius / Math.sin(Math.PI / 12) / narrow).add(center);
  if (controls) controls.target.copy(center);
  upright();
}
function home() { look(sphere.center, sphere.radius); }
/* The view turns about the vertical, and stays above the table: a rolling view loses what is up. */
function upright() {
  const center = controls ? controls.target : sphere.center, eye = camera.position.clone().sub(center);
  const angle = Math.asin(Math.max(-1, Math.min(1, eye.z / eye.length())));
  const kept = Math.max(run.table ? 0.03 : -1.5, Math.min(angle, 1.5)), flat = Math.hypot(eye.x, eye.y) || 1e-9;
  const stretch = eye.length() * Math.cos(kept) / flat;
  camera.position.set(eye.x * stretch, eye.y * stretch, eye.length() * Math.sin(kept)).add(center);
  camera.up.set(0, 0, 1);
  camera.lookAt(center);
  draw();
}
function resize() {
  camera.aspect = stage.clientWidth / stage.clientHeight;
  camera.updateProjectionMatrix();
  if (renderer) renderer.setSize(stage.clientWidth, stage.clientHeight);
  if (controls) controls.handleResize();
  draw();
  plot();
}
