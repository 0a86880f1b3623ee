// The page of a search: a plot of all scenes, and the 3-D view as the reader moves it.

const element = (id) => document.getElementById(id);
const data = JSON.parse(element("data").textContent);
const count = data.parent.length - 1; // without the root, which is node 0
const first = data.from_scene ? 0 : 1; // the root is drawn where the search started from a scene
const viewer = element("viewer");

// -- the 3-D view -------------------------------------------------------------------------------------------------

const view = () => viewer.contentWindow && viewer.contentWindow.sceneViewer;
let timer = 0;

function show(frame) {
  if (!view()) return;
  view().showScene(frame);
  const step = data.steps.indexOf(frame);
  element("playing").textContent = step < 0 ? "" : `step ${step + 1} of ${data.steps.length}`;
}

function stop() {
  clearInterval(timer);
  timer = 0;
  element("play").textContent = "▶ play";
}

function play() {
  let step = 0;
  show(data.steps[0]);
  element("play").textContent = "■ stop";
  timer = setInterval(() => {
    step += 1;
    if (step < data.steps.length) show(data.steps[step]);
    if (step >= data.steps.length - 1) stop();
  }, 1200);
}

element("play").addEventListener("click", () => (timer ? stop() : play()));

function visit(frame) {
  stop();
  show(frame);
  viewer.scrollIntoView({ block: "center", behavior: "smooth" });
}

// -- the cards: the 3-D view draws their pictures, one after another, those in sight alone -------------------------

const due = [];

function paint() {
  if (!due.length) return;
  if (!view()) return void setTimeout(paint, 50); // it is still loading
  const card = due.shift(), canvas = card.firstElementChild;
  const image = view().picture(Number(card.dataset.frame), canvas.width, canvas.height, data.masks[card.dataset.frame]);
  if (image) canvas.getContext("2d").putImageData(image, 0, 0);
  else canvas.hidden = true; // no WebGL
  card.dataset.painted = "";
  setTimeout(paint, 10);
}

const watcher = new IntersectionObserver((entries) => {
  const idle = !due.length;
  for (const { isIntersecting, target } of entries)
    if (isIntersecting) {
      watcher.unobserve(target);
      due.push(target);
    }
  if (idle) paint();
}, { rootMargin: "200px" });

for (const card of document.querySelectorAll("button.card")) {
  card.addEventListener("click", () => visit(Number(card.dataset.frame)));
  watcher.observe(card);
}

// -- the plot -----------------------------------------------------------------------------------------------------

const [LEFT, RIGHT, TOP, BOTTOM] = [46, 990, 12, 336];
const plot = element("plot");
const baseline = data.baseline.slice(0, count); // as many samples as this search made
const values = [...data.objective.slice(first), ...baseline].filter((value) => value !== null);
const [lowest, highest] = [Math.min, Math.max].map((pick) => values.reduce((a, b) => pick(a, b), values[0] ?? 0));
const gap = tickSize(lowest, highest, 6);
const [low, high] = [Math.floor(lowest / gap) * gap, Math.ceil(highest / gap) * gap];

const x = (scene) => LEFT + ((RIGHT - LEFT) * scene) / Math.max(1, count);
const y = (value) => BOTTOM - ((BOTTOM - TOP) * (value - low)) / (high - low || 1);
const at = (scene) => `${x(scene).toFixed(1)} ${y(data.objective[scene]).toFixed(1)}`;
const scored = (scene) => scene >= first && data.objective[scene] !== null;

function draw(name, attributes, text) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== undefined) node.textContent = text;
  plot.append(node);
}

function tickSize(from, to, most) {
  const rough = (to - from || 1) / most;
  const power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map((k) => k * power).find((size) => size >= rough);
}

function ticks(from, to, step) {
  const first = Math.ceil(from / step - 1e-9);
  return Array.from({ length: Math.floor(to / step + 1e-9) - first + 1 }, (_, k) => Number(((first + k) * step).toPrecision(6)));
}

function stairs(numbers) {
  let path = "", best = -Infinity;
  numbers.forEach((value, index) => {
    if (value === null || value <= best) return;
    path += path ? `H${x(index + 1).toFixed(1)}V${y(value).toFixed(1)}` : `M${x(index + 1).toFixed(1)} ${y(value).toFixed(1)}`;
    best = value;
  });
  return path && `${path}H${x(numbers.length).toFixed(1)}`;
}

for (const value of ticks(low, high, gap)) {
  draw("path", { class: "axis", d: `M${LEFT} ${y(value)}H${RIGHT}` });
  draw("text", { x: LEFT - 8, y: y(value) + 4, "text-anchor": "end" }, value);
}
for (const scene of ticks(0, count, Math.ceil(tickSize(0, count, 8)))) draw("text", { x: x(scene), y: BOTTOM + 22, "text-anchor": "middle" }, scene);
draw("text", { x: (LEFT + RIGHT) / 2, y: BOTTOM + 42, "text-anchor": "middle" },
  `scenes, in the order they were made (${data.nfe} denoiser evaluations each)`);
draw("text", { x: 0, y: 0, transform: `translate(11 ${(TOP + BOTTOM) / 2}) rotate(-90)`, "text-anchor": "middle" }, data.name);

const scenes = data.parent.map((_, scene) => scene).filter(scored);
draw("path", { class: "edges", d: scenes.filter((s) => scored(data.parent[s])).map((s) => `M${at(data.parent[s])}L${at(s)}`).join("") });
draw("path", { class: "dots", d: scenes.map((s) => `M${at(s)}h0`).join("") });
if (baseline.length) draw("path", { class: "base", d: stairs(baseline) });
draw("path", { class: "best", d: stairs(data.objective.slice(1)) });
const way = data.path.filter(scored);
if (way.length) draw("path", { class: "way", d: `M${way.map(at).join("L")}` });
draw("path", { class: "way dots", d: way.map((s) => `M${at(s)}h0`).join("") });
for (const scene of Object.keys(data.frame).map(Number).filter(scored)) draw("circle", { class: "rings", cx: x(scene), cy: y(data.objective[scene]), r: 5.5 });

function nearest(event) {
  const box = plot.getBoundingClientRect();
  const [left, top] = [((event.clientX - box.left) * 1000) / box.width, ((event.clientY - box.top) * 380) / box.height];
  let found = null, least = 15 ** 2;
  for (const scene of scenes) {
    const away = (x(scene) - left) ** 2 + (y(data.objective[scene]) - top) ** 2;
    if (away < least) [found, least] = [scene, away];
  }
  return found;
}

function facts(scene) {
  const origin = scene === 0 ? "the scene that the search started from" : data.parent[scene] >= first ? `child ${data.action[scene]} of scene ${data.parent[scene]}` : "a first sample";
  const below = data.below[scene] - 1;
  return [
    `scene ${scene}: ${data.name} ${Number(data.objective[scene].toPrecision(4))}`,
    `${origin}, depth ${data.depth[scene]}`,
    `${data.redo[scene]} slots to redo, ${below} scene${below === 1 ? "" : "s"} below`,
  ];
}

plot.addEventListener("mousemove", (event) => {
  const scene = nearest(event), tip = element("tip");
  tip.hidden = scene === null;
  plot.style.cursor = scene !== null && scene in data.frame ? "pointer" : "";
  if (scene === null) return;
  tip.replaceChildren(...facts(scene).flatMap((line, k) => (k ? [document.createElement("br"), line] : [line])));
  tip.style.left = `${x(scene) / 10}%`;
  tip.style.top = `${(y(data.objective[scene]) * 100) / 380}%`;
});
plot.addEventListener("mouseleave", () => (element("tip").hidden = true));
plot.addEventListener("click", (event) => {
  const scene = nearest(event);
  if (scene !== null && scene in data.frame) visit(data.frame[scene]);
});

document.body.dataset.state = "ready";
