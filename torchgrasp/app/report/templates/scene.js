// The 3D scene: layers of shapes, a camera, and their motion. panel.js makes the panel beside it.
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

// One group of shapes for each layer.
const scene = new THREE.Scene(), layers = {};
scene.background = new THREE.Color("#fcfcfa");
function layer(name) {
  if (!layers[name]) scene.add(layers[name] = new THREE.Group());
  return layers[name];
}

function addCloud(name, buffer, color) {
  const values = { color, size: 2.5 * window.devicePixelRatio, sizeAttenuation: false };
  layer(name).add(new THREE.Points(geometry({ points: buffer }), new THREE.PointsMaterial(values)));
}
addCloud("cloud", run.cloud, "#c2452d");
if (run.others) addCloud("other objects", run.others, "#8b929c");

const surface = geometry(run.surface), shell = geometry(run.surface);
layer("surface").add(new THREE.Mesh(surface, lit({ vertexColors: true })));
layer("shell").add(new THREE.Mesh(shell, lit({ vertexColors: true, transparent: true, opacity: 0.4, depthWrite: false })));
const deviations = unpack(run.surface.std), outward = surface.attributes.normal.array;

function inflate(sigma) {
  const from = surface.attributes.position.array, to = shell.attributes.position.array;
  for (let i = 0; i < to.length; i++) to[i] = from[i] + sigma * deviations[Math.floor(i / 3)] * outward[i];
  shell.attributes.position.needsUpdate = true;
}

const pieces = run.hand.map((piece) => {
  const mesh = new THREE.Mesh(geometry(piece), lit({ color: piece.color }));
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

const ARROW = 0.035; // [m], longer than a fingertip is wide
const shaft = new THREE.CylinderGeometry(0.0012, 0.0012, ARROW, 10).translate(0, ARROW / 2, 0);
const tip = new THREE.ConeGeometry(0.0035, 0.011, 14).translate(0, ARROW, 0);
const ball = new THREE.SphereGeometry(0.0045, 20, 14);
const arrows = run.fingers.map(([, color]) => {
  const arrow = new THREE.Group();
  for (const part of [shaft, tip, ball]) arrow.add(new THREE.Mesh(part, lit({ color })));
  layer("contacts").add(arrow);
  return arrow;
});
const contacts = { points: unpack(run.grasps.points), normals: unpack(run.grasps.normals) };
const postures = unpack(run.grasps.links);

function touch(grasp) {
  arrows.forEach((arrow, finger) => {
    const at = 3 * (grasp * arrows.length + finger);
    arrow.position.fromArray(contacts.points, at);
    arrow.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), new THREE.Vector3().fromArray(contacts.normals, at));
  });
}

const replay = run.replay && Object.fromEntries(
  ["ticks", "object", "links", "time", "forces"].map((name) => [name, unpack(run.replay[name])]));
let truth = null;
if (replay) {
  truth = new THREE.Mesh(geometry(run.replay), lit({ color: run.object, flatShading: true }));
  truth.matrixAutoUpdate = false;
  layer("true object").add(truth);
}

// The first view shows the object, the table and the hand at the first grasp.
const count = run.grasps.rows.length;
surface.computeBoundingBox();
const bounds = surface.boundingBox.clone();
if (count) {
  pose(postures, run.grasps.links.shape, 2);
  scene.updateMatrixWorld(true);
  bounds.union(new THREE.Box3().setFromObject(layers.hand));
}
const sphere = bounds.getBoundingSphere(new THREE.Sphere());
if (run.table) {
  const top = new THREE.Mesh(new THREE.CircleGeometry(1.3 * sphere.radius, 96), new THREE.MeshBasicMaterial({ color: run.table }));
  const middle = surface.boundingBox.getCenter(new THREE.Vector3());
  top.position.set(middle.x, middle.y, -0.0005);
  top.material.side = THREE.DoubleSide;
  layer("table").add(top);
}
const camera = new THREE.PerspectiveCamera(30, 1, sphere.radius / 50, 60 * sphere.radius);
camera.up.set(0, 0, 1);
scene.add(camera, new THREE.AmbientLight(0xffffff, 0.55));
for (const [x, y, z, strength] of [[-0.5, 0.7, 0.6, 0.5], [0.7, 0.1, 0.6, 0.25]]) {
  const lamp = new THREE.DirectionalLight(0xffffff, strength);
  lamp.position.set(x, y, z); // fixed to the camera, whose target is its own centre
  camera.add(lamp, lamp.target);
}
let renderer = null, controls = null;
try {
  // Headless browsers take pictures between two frames, so the last frame is kept.
  renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
} catch (failure) {
  add(stage, "p", { id: "nothing" }, "This browser has no WebGL, which the 3D view needs. The report beside this page has pictures.");
}
function draw() { if (renderer) renderer.render(scene, camera); }
function home() {
  const narrow = Math.min(1, stage.clientWidth / stage.clientHeight);
  camera.position.fromArray(run.eye).multiplyScalar(sphere.radius / Math.sin(Math.PI / 12) / narrow).add(sphere.center);
  camera.up.set(0, 0, 1);
  if (controls) controls.target.copy(sphere.center);
  camera.lookAt(sphere.center);
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
