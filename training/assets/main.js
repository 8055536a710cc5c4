// Wiring of data, view, clock and controls. The address may carry settings: #time=1.5&speed=0.25&theme=dark&renderer=canvas

const THEMES = {
  light: { background: [0.949, 0.957, 0.965], ground: [0.855, 0.875, 0.895], line: [0.68, 0.71, 0.745] },
  dark: { background: [0.078, 0.09, 0.11], ground: [0.17, 0.19, 0.215], line: [0.31, 0.345, 0.385] },
};
const ICONS = { play: "M2 0 L14 7 L2 14 Z", pause: "M1 0 H5 V14 H1 Z M9 0 H13 V14 H9 Z" };

const element = (id) => document.getElementById(id);
const settings = new URLSearchParams(location.hash.slice(1));
const recording = createRecording(JSON.parse(element("recording").textContent));
const scene = createScene(recording);
const canvas = element("view");
const prefers = (query) => matchMedia(query).matches;
const shown = {
  theme: settings.get("theme") ?? (prefers("(prefers-color-scheme: dark)") ? "dark" : "light"),
  contacts: recording.data.contacts !== null,
  follow: false,
};
if (!(shown.theme in THEMES)) shown.theme = "light";

let stale = true;
const changed = () => (stale = true);
const renderer = (settings.get("renderer") !== "canvas" && createWebglRenderer(canvas)) || createCanvasRenderer(canvas);
const camera = createOrbitCamera(recording.data, canvas, changed);
const player = createPlayer(recording, changed);

function fitCanvas() {
  const ratio = Math.min(devicePixelRatio || 1, 2);
  const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
  if (canvas.width === width && canvas.height === height) return;
  [canvas.width, canvas.height] = [width, height];
  changed();
}

function draw() {
  const { view } = recording.data;
  camera.follow((shown.follow && scene.middle(player.time)) || view.target);
  const matrices = camera.matrices(canvas.width / Math.max(canvas.height, 1));
  renderer.draw({
    ...matrices,
    light: scene.light,
    up: scene.up,
    theme: THEMES[shown.theme],
    solids: scene.solids(player.time),
    planes: scene.planes(matrices.target),
    marks: shown.contacts ? scene.marks(player.time) : [],
  });
}

function writeLegend() {
  const contacts = recording.contactsAt(player.time);
  const total = contacts.reduce((sum, { force }) => sum + length(force), 0);
  const forces = recording.typicalForce > 0 ? `<span class="force"></span>force, sum ${total.toPrecision(3)} N` : "";
  element("legend").innerHTML = !shown.contacts
    ? ""
    : `contacts ${contacts.length}<span class="normal"></span>normal${forces}`;
}

function writeControls() {
  const digits = Math.min(Math.max(Math.ceil(-Math.log10(recording.data.dt)) + 1, 2), 5);
  element("clock").textContent = `${player.time.toFixed(digits)} / ${recording.duration.toFixed(digits)} s`;
  element("clock").title = `frame ${recording.frameAt(player.time)} of ${recording.data.frameCount - 1}`;
  element("scrub").value = player.time;
  element("play").innerHTML = `<svg viewBox="0 0 14 14"><path d="${ICONS[player.playing ? "pause" : "play"]}"/></svg>`;
  for (const [id, on] of [["loop", player.looping], ["contacts", shown.contacts], ["follow", shown.follow]])
    element(id).setAttribute("aria-pressed", on);
  document.documentElement.dataset.theme = shown.theme;
  writeLegend();
}

function setSpeed(speed) {
  player.speed = speed;
  element("speed").value = String(speed);
}

function shiftSpeed(by) {
  const { options, selectedIndex } = element("speed");
  setSpeed(Number(options[Math.min(Math.max(selectedIndex + by, 0), options.length - 1)].value));
}

const flip = (name) => () => {
  if (name === "contacts" && !recording.data.contacts) return;
  shown[name] = !shown[name];
  changed();
};
const actions = {
  play: () => player.play(!player.playing),
  loop: () => {
    player.looping = !player.looping;
    changed();
  },
  contacts: flip("contacts"),
  follow: flip("follow"),
  theme: () => {
    shown.theme = shown.theme === "dark" ? "light" : "dark";
    changed();
  },
  reset: camera.reset,
  keys: () => (element("help").hidden = !element("help").hidden),
};
const KEYS = {
  " ": actions.play,
  k: actions.play,
  c: actions.contacts,
  f: actions.follow,
  l: actions.loop,
  t: actions.theme,
  r: actions.reset,
  "?": actions.keys,
  ArrowLeft: () => player.stepFrames(-1),
  ArrowRight: () => player.stepFrames(1),
  ArrowUp: () => shiftSpeed(1),
  ArrowDown: () => shiftSpeed(-1),
  Home: () => player.seek(0),
  End: () => player.seek(recording.duration),
  "+": () => camera.zoom(0.85),
  "=": () => camera.zoom(0.85),
  "-": () => camera.zoom(1 / 0.85),
};

for (const [id, action] of Object.entries(actions))
  element(id).addEventListener("click", () => {
    action();
    // Else the next space bar would press the button again.
    element(id).blur();
  });
element("contacts").disabled = !recording.data.contacts;
element("scrub").max = recording.duration;
element("scrub").addEventListener("input", (event) => {
  player.play(false);
  player.seek(Number(event.target.value));
});
element("speed").addEventListener("change", (event) => setSpeed(Number(event.target.value)));
addEventListener("keydown", (event) => {
  const action = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!action || event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
  // A button reached by the tab key keeps the space bar for itself.
  if (event.key === " " && event.target.tagName === "BUTTON") return;
  event.preventDefault();
  action();
});

let last = null;
function tick(now) {
  fitCanvas();
  player.advance(last === null ? 0 : Math.min((now - last) / 1000, 0.1));
  last = now;
  if (stale) {
    stale = false;
    draw();
    writeControls();
  }
  requestAnimationFrame(tick);
}

camera.reset();
const speeds = [...element("speed").options].map((option) => Number(option.value));
if (speeds.includes(Number(settings.get("speed")))) setSpeed(Number(settings.get("speed")));
if (settings.has("time")) player.seek(Number(settings.get("time")) || 0);
else player.play(!prefers("(prefers-reduced-motion: reduce)"));
document.documentElement.dataset.renderer = renderer.name;
requestAnimationFrame(tick);
