// The state of the page; `show` changes it and updates the scene and the panel.
const state = { grasp: 1, posture: "grasp", sigma: 0, tick: null };
const hidden = new Set();

function show(change) {
  Object.assign(state, change);
  const playing = state.tick !== null;
  if (playing) {
    pose(replay.links, run.replay.links.shape, state.tick);
    place(truth, replay.object, state.tick);
  } else if (count) {
    pose(postures, run.grasps.links.shape, run.postures.length * (state.grasp - 1) + run.postures.indexOf(state.posture));
    touch(state.grasp - 1);
  }
  inflate(state.sigma);
  const absent = { shell: playing || state.sigma === 0, surface: playing, cloud: playing, contacts: playing || !count,
    "true object": !playing, hand: !count && !playing };
  for (const [name, group] of Object.entries(layers)) group.visible = !absent[name] && !hidden.has(name);
  follow.forEach((update) => update(playing));
  Object.assign(document.body.dataset, { ...state, tick: playing ? state.tick : "" });
  draw();
}
const follow = [];

add(panel, "h1", {}, run.title);
add(panel, "p", { className: "source" }, "from " + run.source);
add(panel, "p", { className: run.good ? "verdict" : "verdict bad" }, run.verdict);

add(panel, "h2", {}, "Layers");
for (const name of Object.keys(layers)) {
  const label = add(panel, "label"), box = add(label, "input", { type: "checkbox", checked: true });
  label.append(name);
  box.oninput = () => { hidden[box.checked ? "delete" : "add"](name); show({}); };
}
const first = add(panel, "button", { id: "home" }, "first view");
first.onclick = home;

add(panel, "h2", {}, "Standard deviation of the surface [mm]");
const colors = run.surface.ramp.map((color) => `rgb(${color})`).join(",");
add(panel, "div", { className: "legend", id: "legend" }).style.background = `linear-gradient(90deg,${colors})`;
const ends = add(panel, "div", { className: "ends" });
for (const share of [0, 1 / 3, 2 / 3, 1]) add(ends, "span", {}, (share * run.surface.most_mm).toFixed(1));
const sigmaRow = add(panel, "div", { className: "row" });
add(sigmaRow, "span", {}, "shell");
const sigma = add(sigmaRow, "input", { type: "range", id: "sigma", min: 0, max: 3, step: 0.1 });
const sigmaText = add(sigmaRow, "output");
sigma.oninput = () => show({ sigma: Number(sigma.value), tick: null });
follow.push(() => { sigma.value = state.sigma; sigmaText.value = `${state.sigma.toFixed(1)} standard deviations`; });

if (count) {
  add(panel, "h2", {}, "Posture of the hand");
  const buttons = add(panel, "div", { className: "buttons", id: "postures" });
  for (const name of run.postures) {
    const button = add(buttons, "button", {}, name);
    button.onclick = () => show({ posture: name, tick: null });
    follow.push((playing) => button.classList.toggle("on", !playing && state.posture === name));
  }
  const names = add(panel, "div");
  for (const [name, color] of run.fingers) {
    const label = add(names, "label");
    add(label, "i").style.background = color;
    label.append(name);
  }
}

if (replay) {
  add(panel, "h2", {}, "Closing on the true object, and the force of each fingertip [N]");
  const row = add(panel, "div", { className: "row" });
  const play = add(row, "button", { id: "play" }, "play"), slider = add(row, "input", { type: "range", id: "tick" });
  Object.assign(slider, { min: 0, max: replay.ticks.length - 1, step: 1 });
  const clock = add(row, "output");
  slider.oninput = () => show({ tick: Number(slider.value) });
  let timer = null;
  const stop = () => { clearInterval(timer); timer = null; play.textContent = "play"; };
  play.onclick = () => {
    if (timer) return stop();
    play.textContent = "stop";
    const last = replay.ticks.length - 1, seconds = replay.time[replay.time.length - 1] - replay.time[0];
    if (state.tick === null || state.tick === last) show({ tick: 0 });
    timer = setInterval(() => {
      if (state.tick === null || state.tick >= last) return stop();
      show({ tick: state.tick + 1 });
    }, 1000 * seconds / Math.max(last, 1)); // as fast as it was simulated
  };
  follow.push((playing) => {
    slider.value = playing ? state.tick : 0;
    clock.value = `${replay.time[replay.ticks[playing ? state.tick : 0]].toFixed(2)} s`;
    plot();
  });
  add(panel, "canvas", { id: "plot" });
}

function plot() {
  const canvas = document.getElementById("plot");
  if (!canvas) return;
  const scale = window.devicePixelRatio, width = canvas.clientWidth, height = canvas.clientHeight;
  Object.assign(canvas, { width: width * scale, height: height * scale });
  const pen = canvas.getContext("2d"), { time, forces } = replay, fingers = run.replay.forces.shape[1];
  const finite = forces.filter(Number.isFinite), most = 1.1 * finite.reduce((a, b) => Math.max(a, b), 1);
  const begin = time[0], span = time[time.length - 1] - begin || 1;
  const x = (t) => 30 + (width - 40) * (t - begin) / span, y = (force) => height - 18 - (height - 28) * force / most;
  pen.scale(scale, scale);
  pen.font = "10px sans-serif";
  pen.fillStyle = "#6a717b";
  pen.strokeStyle = "#dcdad3";
  const line = (points) => { pen.beginPath(); points.forEach((p) => pen.lineTo(...p)); pen.stroke(); };
  for (const share of [0, 0.5, 1]) {
    const force = share * most / 1.1;
    line([[30, y(force)], [width - 10, y(force)]]);
    pen.fillText(force.toFixed(1), 4, y(force) + 3);
    pen.fillText(`${(begin + share * span).toFixed(1)} s`, x(begin + share * span) - 14 * share - 6, height - 4);
  }
  for (let finger = 0; finger < fingers; finger++) {
    pen.strokeStyle = (run.fingers[finger] || ["", "#22262b"])[1];
    line(Array.from(time, (t, k) => [x(t), y(forces[k * fingers + finger])]).filter((p) => p.every(Number.isFinite)));
  }
  if (state.tick === null) return;
  pen.strokeStyle = "#22262b";
  const now = x(time[replay.ticks[state.tick]]);
  line([[now, 8], [now, height - 18]]);
}

if (count) {
  add(panel, "h2", {}, "Best grasps");
  const table = add(panel, "table", { id: "grasps" }), head = add(add(table, "thead"), "tr"), body = add(table, "tbody");
  run.grasps.heads.forEach((text) => add(head, "th", {}, text));
  run.grasps.rows.forEach((cells, index) => {
    const row = add(body, "tr");
    cells.forEach((text) => add(row, "td", {}, text));
    row.onclick = () => show({ grasp: index + 1, tick: null });
    follow.push((playing) => row.classList.toggle("on", !playing && state.grasp === index + 1));
  });
}

/* Keys act like buttons and rows; a slider with the focus keeps its arrow keys. */
if (count) {
  add(panel, "p", { className: "source" }, "Keys: up and down step through the grasps, 1 to 4 choose the posture.");
  window.addEventListener("keydown", (event) => {
    const step = { ArrowUp: -1, ArrowDown: 1 }[event.key], posture = run.postures[Number(event.key) - 1];
    if (event.ctrlKey || event.altKey || event.metaKey || (step && event.target.type === "range")) return;
    if (posture) show({ posture, tick: null });
    if (!step) return;
    show({ grasp: Math.min(Math.max(state.grasp + step, 1), count), tick: null });
    event.preventDefault(); // the panel does not scroll
    document.querySelector("#grasps tr.on").scrollIntoView({ block: "nearest" });
  });
}

/* The part of the address after "#" names a state; the page shows an error for an unknown state. */
function read() {
  const asked = new URLSearchParams(location.hash.slice(1)), change = {};
  const most = { grasp: [1, count], sigma: [0, 3], tick: [0, replay ? replay.ticks.length - 1 : -1] };
  for (const [name, text] of asked) {
    const [low, high] = most[name] || [], value = Number(text);
    if (name === "posture" && run.postures.includes(text)) change.posture = text;
    else if (text !== "" && value >= low && value <= high && (name === "sigma" || Number.isInteger(value))) change[name] = value;
    else console.error(`Unknown state in the address: ${name}=${text}`);
  }
  show({ tick: null, ...change });
}

if (renderer) {
  stage.append(renderer.domElement);
  renderer.setPixelRatio(window.devicePixelRatio);
  controls = new THREE.TrackballControls(camera, renderer.domElement);
  Object.assign(controls, { rotateSpeed: 2.5, staticMoving: true });
  controls.addEventListener("change", draw);
  (function turn() { requestAnimationFrame(turn); controls.update(); })();
}
window.addEventListener("resize", resize);
window.addEventListener("hashchange", read);
resize();
home();
read();
panel.append(errors);
document.body.dataset.ready = Math.round(performance.now());
