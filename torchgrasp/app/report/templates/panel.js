// The state of the page; `show` changes it and updates the scene and the panel. A film is the simulated closing of the
// grasp that was closed, or else the planned motion of the chosen grasp; `tick` is a frame of it, or null.
const state = { grasp: 1, posture: "grasp", sigma: 0, tick: null };
const names = ["cloud", "other objects", "surface", "shell", "hand", "contacts", "true object", "table", "axes", "camera", "opened cloud"]
  .filter((name) => layers[name] || name === "opened cloud");
layer("opened cloud");
const wanted = {
  planned: new Set(names.filter((name) => !["shell", "true object"].includes(name))),
  simulated: new Set(["hand", "contacts", "true object", "table", "axes", "camera"]),
};
const PLANNED = [[0, "approach"], [40, "closing"], [60, "squeeze"], [70, "lift"]], LAST = 110; // frames of 25 ms
const simulates = (grasp) => replay !== null && grasp === run.replay.grasp;
const frames = (grasp) => simulates(grasp) ? replay.ticks.length : count ? LAST + 1 : 0;
const seconds = (tick) => simulates(state.grasp) ? replay.time[replay.ticks[tick]] : tick / 40;
const moment = (tick) => (simulates(state.grasp) ? run.replay.moments : PLANNED).filter(([begin]) => begin <= tick).map(([, name]) => name).pop() || "";

function show(change) {
  Object.assign(state, change);
  if (state.tick !== null) state.tick = Math.min(state.tick, frames(state.grasp) - 1);
  const film = state.tick !== null, simulated = film && simulates(state.grasp);
  let rise = 0;
  if (truth) place(truth, replay.object, simulated ? state.tick : 0);
  if (simulated) {
    pose(replay.links, run.replay.links.shape, state.tick);
    press(state.tick);
  } else if (count) {
    const first = run.postures.length * (state.grasp - 1);
    if (film) rise = move(first, state.tick);
    else pose(postures, run.grasps.links.shape, first + run.postures.indexOf(state.posture));
    touch(state.grasp - 1, rise);
  }
  for (const name of ["cloud", "surface", "shell"]) layers[name].position.z = rise;
  inflate(state.sigma);
  const chosen = wanted[simulated ? "simulated" : "planned"];
  chosen[state.sigma > 0 ? "add" : "delete"]("shell");
  names.forEach((name) => { layers[name].visible = chosen.has(name) && layers[name].children.length > 0; });
  if (!count && !simulated) layers.hand.visible = layers.contacts.visible = false;
  follow.forEach((update) => update(film, simulated));
  Object.assign(document.body.dataset, { ...state, tick: film ? state.tick : "" });
  draw();
}
const follow = [];

/* Pose the hand at a frame of the planned motion; return how far [m] it has lifted the surface. */
function move(first, tick) {
  const step = PLANNED.filter(([begin]) => begin <= tick).length - 1;
  const share = (tick - PLANNED[step][0]) / ((PLANNED[step + 1] || [LAST])[0] - PLANNED[step][0]);
  const smooth = share * share * (3 - 2 * share), rise = step === 3 ? LIFT * smooth : 0;
  blend(postures, run.grasps.links.shape, first + Math.min(step, 2), step === 3 ? 1 : smooth, rise);
  return rise;
}

// What the picture shows, in words on the picture; below it the film.
const caption = add(stage, "div", { id: "caption" });
add(caption, "h1", {}, run.title);
const story = add(caption, "p"), bar = add(stage, "div", { id: "film", className: "row" });
const legend = add(caption, "p", { className: "source" });
const VIRIDIS = `linear-gradient(90deg,${run.surface.ramp.map((color) => `rgb(${color})`).join(",")})`;
const SAID = {
  planned: [["#c2452d", "what the camera saw"], [VIRIDIS, "the estimated surface, yellow where it is uncertain"]],
  simulated: [[run.object, "the true object"], ["#2f6db5", "arrows: the force on each fingertip, 1 cm for 1 N"]],
};
follow.push((film, simulated) => {
  const who = count ? `Grasp ${state.grasp} of ${count}` : "No grasp", odds = count ? run.grasps.rows[state.grasp - 1][1] : "";
  story.textContent = simulated ? `${who}, simulated on the true object: ${moment(state.tick)}.`
    : film ? `${who}, its planned motion: ${moment(state.tick)}. ${replay ? `Only grasp ${run.replay.grasp} was simulated.` : "Nothing was simulated."}`
      : count ? `${who}${odds ? `, predicted success ${odds}` : ""}: the hand at its ${state.posture}.` : run.verdict;
  legend.replaceChildren();
  for (const [color, words] of SAID[simulated ? "simulated" : "planned"]) {
    add(legend, "i").style.background = color;
    add(legend, "span", {}, words);
  }
  if (run.table) add(legend, "span", {}, "squares of 5 cm");
});

add(panel, "p", { className: run.good ? "verdict" : "verdict bad" }, run.verdict);
add(panel, "p", { className: "source" }, "from " + run.source);

add(panel, "h2", {}, "Layers");
for (const name of names) {
  const label = add(panel, "label"), box = add(label, "input", { type: "checkbox" });
  label.append(name);
  box.oninput = () => {
    if (name === "shell") return show({ sigma: box.checked ? 2 : 0 });
    wanted[state.tick !== null && simulates(state.grasp) ? "simulated" : "planned"][box.checked ? "add" : "delete"](name);
    show({});
  };
  // What is ticked is drawn: a layer without anything to show is neither.
  follow.push(() => {
    box.checked = layers[name].visible;
    label.hidden = layers[name].children.length === 0 || (!count && !replay && ["hand", "contacts"].includes(name));
  });
}
const first = add(panel, "button", { id: "home" }, "first view");
first.onclick = home;

add(panel, "h2", {}, "Standard deviation of the surface [mm]");
add(panel, "div", { className: "legend", id: "legend" }).style.background = VIRIDIS;
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
    follow.push((film) => button.classList.toggle("on", !film && state.posture === name));
  }
  const fingers = add(panel, "div");
  for (const [name, color] of run.fingers) {
    const label = add(fingers, "label");
    add(label, "i").style.background = color;
    label.append(name);
  }
}

if (frames(1)) {
  const play = add(bar, "button", { id: "play" }, "play"), slider = add(bar, "input", { type: "range", id: "tick" });
  Object.assign(slider, { min: 0, step: 1 });
  const clock = add(bar, "output");
  slider.oninput = () => show({ tick: Number(slider.value) });
  let timer = null;
  const stop = () => { clearInterval(timer); timer = null; play.textContent = "play"; };
  play.onclick = () => {
    if (timer) return stop();
    play.textContent = "stop";
    const grasp = state.grasp, last = frames(grasp) - 1;
    if (state.tick === null || state.tick === last) show({ tick: 0 });
    timer = setInterval(() => {
      if (state.tick === null || state.grasp !== grasp || state.tick >= last) return stop();
      show({ tick: state.tick + 1 });
    }, 1000 * (seconds(last) - seconds(0)) / Math.max(last, 1)); // as fast as it was simulated
  };
  follow.push((film) => {
    slider.max = frames(state.grasp) - 1;
    slider.value = film ? state.tick : 0;
    clock.value = `${seconds(film ? state.tick : 0).toFixed(2)} s`;
  });
}
if (replay) {
  add(panel, "h2", {}, `Grasp ${run.replay.grasp} closed on the true object: force of each fingertip [N]`);
  add(panel, "canvas", { id: "plot" });
  add(panel, "p", { className: "source" }, run.replay.story);
  follow.push(plot);
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
  pen.setLineDash([2, 3]);
  pen.strokeStyle = "#6a717b";
  for (const [tick] of run.replay.moments) line([[x(time[replay.ticks[tick]]), 8], [x(time[replay.ticks[tick]]), height - 18]]);
  if (state.tick === null || !simulates(state.grasp)) return;
  pen.setLineDash([]);
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
    if (simulates(index + 1)) row.title = "simulated";
    follow.push(() => row.classList.toggle("on", state.grasp === index + 1));
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
  const chosen = Number(asked.get("grasp")) || 1; // its film has so many frames
  const most = { grasp: [1, count], sigma: [0, 3], tick: [0, frames(chosen) - 1] };
  for (const [name, text] of asked) {
    const [low, high] = most[name] || [], value = Number(text);
    if (name === "posture" && run.postures.includes(text)) change.posture = text;
    else if (text !== "" && value >= low && value <= high && (name === "sigma" || Number.isInteger(value))) change[name] = value;
    else console.error(`Unknown state in the address: ${name}=${text}`);
  }
  show({ tick: null, ...change });
}

add(panel, "h2", {}, "Another cloud");
const opener = add(panel, "input", { type: "file", id: "open", accept: ".ply,.pcd,.xyz,.pts,.txt,.csv" });
const heard = add(panel, "p", { className: "source", id: "heard" }, "Choose a .ply, .pcd or text file, or drop it on this page. It is shown in the frame of the axes and goes nowhere else.");
const say = (words) => { heard.textContent = words; };
opener.onchange = () => opener.files[0] && openCloud(opener.files[0], say);
window.addEventListener("dragover", (event) => event.preventDefault());
window.addEventListener("drop", (event) => {
  event.preventDefault();
  const file = event.dataTransfer.files[0];
  if (file) openCloud(file, say);
});

if (renderer) {
  stage.append(renderer.domElement);
  renderer.setPixelRatio(window.devicePixelRatio);
  controls = new THREE.TrackballControls(camera, renderer.domElement);
  Object.assign(controls, { rotateSpeed: 2.5, staticMoving: true });
  controls.addEventListener("change", upright);
  (function turn() { requestAnimationFrame(turn); controls.update(); })();
}
window.addEventListener("resize", resize);
window.addEventListener("hashchange", read);
resize();
home();
read();
panel.append(errors);
document.body.dataset.ready = Math.round(performance.now());
