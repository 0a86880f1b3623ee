// Mouse, touch and keys. Loaded before app.js, whose functions it calls when something happens.

const CLICK = 4; // pixels that a pointer may move in a click

function turn(dx, dy) {
  const camera = ownCamera();
  camera.azimuth = ((camera.azimuth - 0.4 * dx + 540) % 360) - 180;
  camera.elevation = clamp(camera.elevation + 0.4 * dy, -89.9, 89.9);
}

// Shift the target so that what is under the pointer follows it.
function shift(dx, dy) {
  const camera = ownCamera();
  const [right, up] = cameraAxes(camera.azimuth, camera.elevation);
  const step = (2 * camera.distance * Math.tan(radians(data.view.fov) / 2)) / canvas.clientHeight;
  camera.target = add(camera.target, add(scale(right, -dx * step), scale(up, dy * step)));
}

// Come nearer by a factor; the point under the pointer (pixels from the middle of the canvas) stays where it is.
function zoom(factor, x = 0, y = 0) {
  const camera = ownCamera();
  const distance = clamp(camera.distance * factor, 0.01 * data.view.radius, 40 * data.view.radius);
  const used = distance / camera.distance;
  shift(x * (used - 1), y * (used - 1));
  camera.distance = distance;
}

function reset() {
  state.camera = null;
  changed();
}

function lookDown() {
  state.camera = fitView(pointsToSee(scenes[state.scene]), 0, 89.9, data.view.fov, viewAspect(), 0.05);
  changed();
}

function slotAt(event) {
  const box = canvas.getBoundingClientRect();
  const ratio = canvas.width / box.width;
  const [x, y] = [event.clientX - box.left, event.clientY - box.top].map((value) => Math.floor(value * ratio));
  if (x < 0 || y < 0 || x >= canvas.width || y >= canvas.height) return -1;
  return renderer.slots(cameraNow(), look(), x, y, 1, 1)[0];
}

function hover(event) {
  const slot = slotAt(event);
  const tooltip = element("tooltip");
  const object = findObject(slot);
  tooltip.hidden = !object;
  canvas.classList.toggle("over", Boolean(object));
  if (object) {
    const box = canvas.getBoundingClientRect();
    tooltip.textContent = data.assets[object.asset].label;
    tooltip.style.left = `${event.clientX - box.left}px`;
    tooltip.style.top = `${event.clientY - box.top}px`;
  }
  if (slot !== state.hovered) {
    state.hovered = slot;
    redraw();
  }
}

function listenToPointers() {
  const pointers = new Map();
  let travelled = 0;
  let pending = null;
  const lookUnder = (event) => {
    if (!pending) requestAnimationFrame(() => {
      if (pending && pointers.size === 0) hover(pending);
      pending = null;
    });
    pending = event;
  };
  const spread = () => {
    const [a, b] = Array.from(pointers.values());
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, size: Math.hypot(a.x - b.x, a.y - b.y) };
  };
  const fromMiddle = (x, y) => {
    const box = canvas.getBoundingClientRect();
    return [x - box.left - box.width / 2, y - box.top - box.height / 2];
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (pointers.size === 1) travelled = 0;
    element("tooltip").hidden = true;
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!renderer) return;
    const before = pointers.get(event.pointerId);
    if (!before) {
      if (event.pointerType === "mouse") lookUnder(event);
      return;
    }
    const [dx, dy] = [event.clientX - before.x, event.clientY - before.y];
    travelled += Math.abs(dx) + Math.abs(dy);
    const start = pointers.size === 2 ? spread() : null;
    Object.assign(before, { x: event.clientX, y: event.clientY });
    if (start) {
      const now = spread();
      shift(now.x - start.x, now.y - start.y);
      if (start.size > 0 && now.size > 0) zoom(start.size / now.size, ...fromMiddle(now.x, now.y));
    } else if (event.buttons & 6 || event.shiftKey) shift(dx, dy);
    else turn(dx, dy);
    canvas.classList.add("moving");
    changed();
  });
  const lift = (event) => {
    const known = pointers.delete(event.pointerId);
    canvas.classList.remove("moving");
    if (known && event.type === "pointerup" && event.button === 0 && travelled <= CLICK && renderer)
      select(slotAt(event));
  };
  canvas.addEventListener("pointerup", lift);
  canvas.addEventListener("pointercancel", lift);
  canvas.addEventListener("pointerleave", () => {
    element("tooltip").hidden = true;
    if (state.hovered < 0) return;
    state.hovered = -1;
    redraw();
  });
  canvas.addEventListener("dblclick", (event) => {
    const object = renderer && findObject(slotAt(event));
    if (!object) return;
    ownCamera().target = object.translation;
    changed();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    if (!renderer) return;
    const lines = event.deltaMode === 1 ? 33 : 1;
    zoom(Math.exp(0.0012 * clamp(event.deltaY * lines, -300, 300)), ...fromMiddle(event.clientX, event.clientY));
    changed();
  }, { passive: false });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
}

function listenToKeys() {
  const turned = (name) => {
    const values = Array.from(element(name).options, (option) => option.value);
    return () => choose(name, values[(values.indexOf(state[name]) + 1) % values.length]);
  };
  const actions = {
    ArrowLeft: () => showScene(state.scene - 1),
    ArrowRight: () => showScene(state.scene + 1),
    Home: () => showScene(0),
    End: () => showScene(scenes.length - 1),
    Escape: () => select(-1),
    c: turned("colors"),
    p: turned("shape"),
    b: switchBackground,
    t: lookDown,
    r: reset,
    "+": () => [zoom(0.85), changed()],
    "-": () => [zoom(1 / 0.85), changed()],
  };
  document.addEventListener("keydown", (event) => {
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    const busy = event.ctrlKey || event.metaKey || event.altKey || ["SELECT", "INPUT"].includes(event.target.tagName);
    if (!action || busy || (!renderer && event.key.length === 1)) return;
    event.preventDefault();
    action();
  });
}

function switchBackground() {
  choose("background", state.background === "light" ? "dark" : "light");
}

function listen() {
  listenToPointers();
  listenToKeys();
  for (const name of ["colors", "shape"])
    element(name).addEventListener("change", (event) => choose(name, event.target.value));
  element("background").addEventListener("click", switchBackground);
  element("top").addEventListener("click", lookDown);
  element("reset").addEventListener("click", reset);
  element("previous").addEventListener("click", () => showScene(state.scene - 1));
  element("next").addEventListener("click", () => showScene(state.scene + 1));
  element("slider").addEventListener("input", (event) => showScene(Number(event.target.value)));
  window.addEventListener("hashchange", readAddress);
  new ResizeObserver(() => renderer && draw()).observe(canvas); // at once: a stretched image is never shown
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => window.location.reload());
}
