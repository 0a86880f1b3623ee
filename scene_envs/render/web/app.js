// The page: what is shown, and what the user does about it.

const element = (id) => document.getElementById(id);
const data = JSON.parse(element("data").textContent);
const scenes = data.scenes.map(decodeScene);
const canvas = element("canvas");
const state = {
  scene: 0,
  camera: null, // the first view
  colors: "natural",
  shape: "visual",
  background: "light",
  selected: -1,
  hovered: -1,
  hidden: new Set(),
};
let renderer = null;
let waiting = false;

function report(problem) {
  document.body.dataset.errors = String(Number(document.body.dataset.errors) + 1);
  element("message").textContent = problem;
  element("message").hidden = false;
}
window.addEventListener("error", (event) => report(event.message));

// -- what is shown ------------------------------------------------------------------------------------------------

const look = () => ({
  colors: state.colors, shape: state.shape, background: state.background, hovered: state.hovered,
  selected: state.selected,
});

// What a view of a scene should hold: the support, and the objects in the workspace.
function pointsToSee(objects) {
  const [low, high] = data.view.workspace;
  const inside = objects.filter(({ translation }) => translation.every((v, i) => low[i] <= v && v <= high[i]));
  const free = inside.filter(({ asset }) => !data.assets[asset].welded);
  return [...data.view.points, ...free.flatMap((object) => boxCorners(data.assets[object.asset].visual, object))];
}

const viewAspect = () => canvas.clientWidth / Math.max(1, canvas.clientHeight);

function homeView(index = state.scene, aspect = viewAspect()) {
  const { azimuth, elevation, fov } = data.view;
  return fitView(pointsToSee(scenes[index]), azimuth, elevation, fov, aspect, 0.05);
}

const cameraNow = () => state.camera || homeView();

// The camera to be moved: from now on it is the user's.
function ownCamera() {
  state.camera = cameraNow();
  return state.camera;
}

function draw() {
  waiting = false;
  const sharpness = Math.min(window.devicePixelRatio || 1, 2);
  const pixels = (size) => Math.max(1, Math.round(size * sharpness));
  const [width, height] = [pixels(canvas.clientWidth), pixels(canvas.clientHeight)];
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  renderer.draw(cameraNow(), look());
  const error = renderer.gl.getError();
  if (error && !renderer.gl.isContextLost()) report(`WebGL error ${error}`);
  document.body.dataset.drawn = String(renderer.drawn);
  document.body.dataset.state = "ready";
}

function redraw() {
  if (renderer && !waiting) requestAnimationFrame(draw);
  waiting = true;
}

function showScene(index) {
  state.scene = clamp(index, 0, scenes.length - 1);
  state.selected = state.hovered = -1;
  const objects = scenes[state.scene];
  if (renderer) renderer.setObjects(objects, state.hidden);
  element("caption").textContent = data.scenes[state.scene].caption;
  element("count").textContent = objects.length === 1 ? "1 object" : `${objects.length} objects`;
  element("number").textContent = `scene ${state.scene}`;
  element("number").title = `${scenes.length} scenes, counted from 0`;
  element("slider").value = state.scene;
  Array.from(element("strip").children).forEach((tile, k) => {
    tile.setAttribute("aria-selected", String(k === state.scene));
    if (k === state.scene) tile.scrollIntoView({ block: "nearest", inline: "nearest" });
  });
  Object.assign(document.body.dataset, { scene: state.scene, objects: objects.length });
  showLegend();
  showDetails();
  changed();
}

function showLegend() {
  const counts = new Map();
  for (const { asset } of scenes[state.scene]) counts.set(asset, (counts.get(asset) || 0) + 1);
  const order = Array.from(counts.keys()).sort((a, b) => data.assets[a].label.localeCompare(data.assets[b].label));
  element("legend").replaceChildren(...order.map((index) => {
    const asset = data.assets[index];
    const shared = data.assets.some((other) => other !== asset && other.label === asset.label);
    const exact = document.createElement("small");
    exact.textContent = shared ? asset.name : "";
    const row = document.createElement("li");
    row.className = state.hidden.has(index) ? "off" : "";
    row.title = `${asset.name}: click to hide or show`;
    const swatch = document.createElement("span");
    swatch.className = "swatch";
    swatch.style.background = `rgb(${asset.color.join(" ")})`;
    const many = document.createElement("span");
    many.className = "how-many";
    many.textContent = counts.get(index);
    row.append(swatch, asset.label, exact, many);
    row.addEventListener("click", () => {
      if (!state.hidden.delete(index)) state.hidden.add(index);
      if (renderer) renderer.setObjects(scenes[state.scene], state.hidden);
      showLegend();
      redraw();
    });
    return row;
  }));
}

const findObject = (slot) => scenes[state.scene].find((object) => object.slot === slot);
const fixed = (values, digits) => values.map((value) => value.toFixed(digits)).join(", ");

function objectFacts(object) {
  return [
    ["asset", data.assets[object.asset].name],
    ["slot", object.slot],
    ["position", `${fixed(object.translation, 4)} m`],
    ["roll, pitch, yaw", `${fixed(rollPitchYaw(object.quaternion), 1)}°`],
    ["quaternion wxyz", fixed(object.quaternion, 3)],
    ["welded", data.assets[object.asset].welded ? "yes" : "no"],
  ];
}

function showDetails() {
  const object = findObject(state.selected);
  element("details").hidden = !object;
  document.body.dataset.selected = object ? String(object.slot) : "";
  if (!object) return;
  element("object-name").textContent = data.assets[object.asset].label;
  element("object-facts").replaceChildren(...objectFacts(object).flatMap(([name, value]) => {
    const [term, fact] = ["dt", "dd"].map((tag) => document.createElement(tag));
    [term.textContent, fact.textContent] = [name, value];
    return [term, fact];
  }));
}

function select(slot) {
  state.selected = slot;
  showDetails();
  changed();
}

function choose(name, value) {
  state[name] = value;
  if (name === "background") document.body.dataset.background = value;
  else element(name).value = value;
  changed();
}

// -- the address: #scene=3&azimuth=-60&... ------------------------------------------------------------------------

let writing = 0;

function changed() {
  redraw();
  clearTimeout(writing);
  writing = setTimeout(writeAddress, 300);
}

function writeAddress() {
  const parts = { scene: state.scene };
  if (state.camera) {
    const { azimuth, elevation, distance, target } = state.camera;
    Object.assign(parts, {
      azimuth: azimuth.toFixed(1), elevation: elevation.toFixed(1), distance: distance.toPrecision(5),
      target: target.map((value) => value.toFixed(4)).join(","),
    });
  }
  for (const name of ["colors", "shape", "background"]) parts[name] = state[name];
  if (state.selected >= 0) parts.select = state.selected;
  const address = "#" + Object.entries(parts).map(([name, value]) => `${name}=${value}`).join("&");
  try {
    window.history.replaceState(null, "", address);
  } catch {
    // some browsers refuse this for pages from files; the view is only not remembered then
  }
}

function readAddress() {
  const asked = new URLSearchParams(window.location.hash.slice(1));
  const number = (name, otherwise) => {
    const value = parseFloat(asked.get(name));
    return Number.isFinite(value) ? value : otherwise;
  };
  for (const name of ["colors", "shape"]) {
    const known = Array.from(element(name).options, (option) => option.value);
    if (known.includes(asked.get(name))) choose(name, asked.get(name));
  }
  if (asked.get("background") in BACKDROPS) choose("background", asked.get("background"));
  showScene(Math.round(number("scene", state.scene)));
  if (["azimuth", "elevation", "distance", "target"].some((name) => asked.has(name))) {
    const home = homeView();
    const target = (asked.get("target") || "").split(",").map(parseFloat);
    state.camera = {
      azimuth: number("azimuth", home.azimuth),
      elevation: clamp(number("elevation", home.elevation), -89.9, 89.9),
      distance: Math.max(1e-3, number("distance", home.distance)),
      target: target.length === 3 && target.every(Number.isFinite) ? target : home.target,
    };
  }
  if (asked.has("select")) select(Math.round(number("select", -1)));
}

// A small picture of a scene as ImageData, with some slots marked; nothing without WebGL.
function picture(index, width, height, marked = []) {
  if (!renderer) return null;
  const chosen = 65535; // a slot that no scene has
  const objects = scenes[index].map((object) => (marked.includes(object.slot) ? { ...object, slot: chosen } : object));
  renderer.setObjects(objects, new Set());
  const plain = { ...look(), colors: "natural", shape: "visual", hovered: -1, selected: marked.length ? chosen : -1 };
  const image = renderer.snapshot(homeView(index, width / height), plain, width, height);
  renderer.setObjects(scenes[state.scene], state.hidden);
  return image;
}

// -- scenes -------------------------------------------------------------------------------------------------------

function makeStrip() {
  element("scenes").hidden = scenes.length < 2;
  element("slider").max = scenes.length - 1;
  if (scenes.length < 2) return;
  const due = [];
  const paint = () => {
    const tile = due.shift();
    tile.getContext("2d").putImageData(picture(Number(tile.dataset.scene), tile.width, tile.height), 0, 0);
    document.body.dataset.thumbnails = String(Number(document.body.dataset.thumbnails || 0) + 1);
    if (due.length) setTimeout(paint, 10);
    else redraw();
  };
  const watcher = new IntersectionObserver((entries) => {
    const idle = due.length === 0;
    for (const entry of entries.filter((each) => each.isIntersecting)) {
      watcher.unobserve(entry.target);
      if (renderer) due.push(entry.target);
    }
    if (idle && due.length) setTimeout(paint, 10);
  }, { root: element("strip"), rootMargin: "200px" });
  scenes.forEach((_, index) => {
    const tile = document.createElement("canvas");
    [tile.width, tile.height, tile.dataset.scene, tile.title] = [224, 168, index, data.scenes[index].caption];
    tile.setAttribute("role", "option");
    tile.addEventListener("click", () => showScene(index));
    element("strip").append(tile);
    watcher.observe(tile);
  });
}

// -- without WebGL ------------------------------------------------------------------------------------------------

function showText() {
  canvas.hidden = element("tools").hidden = true;
  const box = document.createElement("div");
  box.id = "text";
  element("stage").append(box);
  const write = () => {
    const rows = [["asset", "slot", "position (m)", "roll, pitch, yaw (°)"]];
    for (const object of scenes[state.scene])
      rows.push([data.assets[object.asset].label, object.slot, fixed(object.translation, 4),
        fixed(rollPitchYaw(object.quaternion), 1)]);
    const table = document.createElement("table");
    rows.forEach((row, k) => row.forEach((value, column) => {
      const line = column ? table.rows[k] : table.insertRow();
      const cell = line.appendChild(document.createElement(k ? "td" : "th"));
      cell.textContent = value;
    }));
    const note = document.createElement("p");
    note.textContent = "This browser has no WebGL 2, so the scene is listed instead of drawn.";
    box.replaceChildren(note, table);
  };
  new MutationObserver(write).observe(document.body, { attributes: true, attributeFilter: ["data-scene"] });
  write();
  document.body.dataset.state = "text";
}

// -- start --------------------------------------------------------------------------------------------------------

try {
  renderer = new Renderer(canvas, data);
} catch (problem) {
  if (canvas.getContext("webgl2")) report(problem.message);
}
makeStrip();
listen();
readAddress();
Object.assign(document.body.dataset, { scenes: scenes.length });
if (renderer) redraw();
else showText();

// For scripts: the state, drawing at once, small pictures, and the slots seen in the canvas (row by row from below).
window.sceneViewer = {
  state,
  showScene,
  picture,
  draw,
  camera: cameraNow,
  size: () => [canvas.width, canvas.height],
  slots: () => renderer.slots(cameraNow(), look(), 0, 0, canvas.width, canvas.height),
};
