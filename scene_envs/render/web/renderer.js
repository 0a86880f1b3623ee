// Drawing with WebGL 2: one instanced draw per asset, a depth image from the sun, ambient occlusion, a picking image.

const SUN_PIXELS = { table: 2048, room: 4096 };
const BACKDROPS = {
  light: { upper: [0.98, 0.976, 0.97], lower: [0.875, 0.89, 0.91], shadow: 0.24 },
  dark: { upper: [0.16, 0.175, 0.2], lower: [0.085, 0.09, 0.105], shadow: 0.5 },
};

class Renderer {
  constructor(canvas, data) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
    if (!gl) throw new Error("WebGL 2 is not available");
    this.gl = gl;
    this.view = data.view;
    this.programs = {
      object: new Program(gl, OBJECT_VERTEX, OBJECT_FRAGMENT),
      slot: new Program(gl, OBJECT_VERTEX, SLOT_FRAGMENT),
      depth: new Program(gl, OBJECT_VERTEX, DEPTH_FRAGMENT),
      backdrop: new Program(gl, SCREEN_VERTEX, BACKDROP_FRAGMENT),
      ground: new Program(gl, GROUND_VERTEX, GROUND_FRAGMENT),
      occlusion: new Program(gl, SCREEN_VERTEX, OCCLUSION_FRAGMENT),
      composite: new Program(gl, SCREEN_VERTEX, COMPOSITE_FRAGMENT),
    };
    this.assets = data.assets.map((asset) => ({
      ...asset,
      count: 0,
      instances: gl.createBuffer(),
      shapes: {},
      tint: asset.color.map((channel) => channel / 255),
    }));
    this.blank = gl.createVertexArray();
    this.sun = this.makeSun();
    this.screen = new Target(gl);
    this.small = new Target(gl);
    this.sunFor = null;
  }

  // The objects to draw, as decodeScene gives them; objects of hidden assets are left out.
  setObjects(objects, hidden) {
    const gl = this.gl;
    this.drawn = 0;
    this.assets.forEach((asset, index) => {
      const mine = hidden.has(index) ? [] : objects.filter((object) => object.asset === index);
      const values = mine.flatMap((object) => [...object.translation, ...object.quaternion, object.slot]);
      gl.bindBuffer(gl.ARRAY_BUFFER, asset.instances);
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(values), gl.DYNAMIC_DRAW);
      asset.count = mine.length;
      this.drawn += mine.length;
    });
    this.sunFor = null;
  }

  // Draw into the canvas.
  draw(camera, look) {
    const { canvas } = this.gl;
    this.screen.resize(canvas.width, canvas.height);
    this.paint(camera, look, this.screen, null);
  }

  // Draw into an image of its own: ImageData of width x height pixels.
  snapshot(camera, look, width, height) {
    const gl = this.gl;
    this.small.resize(width, height);
    this.paint(camera, look, this.small, this.small.output.frame);
    const [raw, image] = [this.read(this.small.output.frame, 0, 0, width, height), new ImageData(width, height)];
    for (let row = 0; row < height; row++)
      image.data.set(raw.subarray(4 * width * (height - 1 - row), 4 * width * (height - row)), 4 * width * row);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return image;
  }

  // The slots seen in a rectangle of the canvas (pixels from its upper left), row by row from below; -1 for none.
  slots(camera, look, x, y, width, height) {
    const gl = this.gl;
    const target = this.screen;
    target.resize(gl.canvas.width, gl.canvas.height);
    const from = target.height - y - height;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.pick.frame);
    gl.viewport(0, 0, target.width, target.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(x, from, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const program = this.programs.slot.use({ viewProjection: this.lens(camera, target).viewProjection });
    this.drawObjects(program, look);
    gl.disable(gl.SCISSOR_TEST);
    const raw = this.read(target.pick.frame, x, from, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return Int32Array.from({ length: width * height }, (_, k) => raw[4 * k] + 256 * raw[4 * k + 1] - 1);
  }

  paint(camera, look, target, output) {
    const gl = this.gl;
    this.shineSun(look);
    const { viewProjection, eye, lens } = this.lens(camera, target);
    const backdrop = BACKDROPS[look.background];
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.many.frame);
    gl.viewport(0, 0, target.width, target.height);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.disable(gl.DEPTH_TEST);
    this.fill(this.programs.backdrop.use({ upper: backdrop.upper, lower: backdrop.lower }));
    const sun = { sunDepth: this.sun.depth, sunMatrix: this.sun.matrix, texel: this.sun.texel };
    if (eye[2] > this.view.ground) this.drawGround(viewProjection, sun, backdrop.shadow);
    gl.enable(gl.DEPTH_TEST);
    const program = this.programs.object.use({
      ...sun, viewProjection, eye, toSun: this.view.light, byClass: look.colors === "classes",
      hovered: look.hovered, selected: look.selected,
    });
    this.drawObjects(program, look);
    target.resolve();
    gl.disable(gl.DEPTH_TEST);
    const { image, depth } = target.single;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.shade.frame);
    this.fill(this.programs.occlusion.use({ depth, lens, radius: this.view.contact }));
    gl.bindFramebuffer(gl.FRAMEBUFFER, output);
    this.fill(this.programs.composite.use({ image, occlusion: target.shade.image, depth, lens }));
  }

  drawObjects(program, look) {
    const gl = this.gl;
    for (const asset of this.assets) {
      if (asset.count === 0) continue;
      const mesh = this.shape(asset, look.shape);
      program.set({ low: mesh.low, size: mesh.size, classColor: asset.tint });
      gl.bindVertexArray(mesh.array);
      gl.drawElementsInstanced(gl.TRIANGLES, mesh.corners, mesh.type, 0, asset.count);
    }
    gl.bindVertexArray(null);
  }

  drawGround(viewProjection, sun, strength) {
    const gl = this.gl;
    const center = [this.view.center[0], this.view.center[1], this.view.ground];
    this.programs.ground.use({ ...sun, viewProjection, center, reach: 2.2 * this.view.radius, strength });
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.blank);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    gl.disable(gl.BLEND);
  }

  fill() {
    this.gl.bindVertexArray(this.blank);
    this.gl.drawArrays(this.gl.TRIANGLES, 0, 3);
  }

  lens(camera, target) {
    const eye = add(camera.target, scale(direction(camera.azimuth, camera.elevation), camera.distance));
    const away = Math.hypot(...subtract(eye, this.view.center));
    const near = Math.max(0.02 * camera.distance, away - 2.5 * this.view.radius);
    const far = away + 6 * this.view.radius;
    const aspect = target.width / target.height;
    const slope = Math.tan(radians(this.view.fov) / 2);
    const view = viewMatrix(cameraAxes(camera.azimuth, camera.elevation), eye);
    const viewProjection = multiply(perspective(this.view.fov, aspect, near, far), view);
    return { eye, viewProjection, lens: [slope * aspect, slope, near, far] };
  }

  // Draw the depth image of the sun again, when the objects or their shape have changed.
  shineSun(look) {
    if (this.sunFor === look.shape) return;
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.sun.frame);
    gl.viewport(0, 0, this.sun.pixels, this.sun.pixels);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(1.5, 3);
    this.drawObjects(this.programs.depth.use({ viewProjection: this.sun.matrix }), look);
    gl.disable(gl.POLYGON_OFFSET_FILL);
    this.sunFor = look.shape;
  }

  makeSun() {
    const gl = this.gl;
    const { light, center, radius } = this.view;
    const half = 1.15 * radius;
    const pixels = Math.min(radius > 2 ? SUN_PIXELS.room : SUN_PIXELS.table, gl.getParameter(gl.MAX_TEXTURE_SIZE));
    const side = Math.abs(light[2]) > 0.99 ? [1, 0, 0] : unit(cross([0, 0, 1], light));
    const view = viewMatrix([side, cross(light, side), light], add(center, scale(light, 3 * radius)));
    const depth = makeTexture(gl, gl.DEPTH_COMPONENT24, pixels, pixels);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    const frame = makeFrame(gl, { depth });
    const matrix = multiply(orthographic(half, 6 * radius), view);
    return { depth, frame, pixels, matrix, texel: (2 * half) / pixels };
  }

  // The mesh of an asset in one of its shapes, made when it is first drawn.
  shape(asset, name) {
    if (!asset.shapes[name]) {
      const mesh = name === "visual" ? decodeVisual(asset.visual) : decodeParts(asset[name], asset.color);
      asset.shapes[name] = this.upload(mesh, asset.instances);
    }
    return asset.shapes[name];
  }

  upload(mesh, instances) {
    const gl = this.gl;
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    const attribute = (place, values, type) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, type, true, 0, 0);
    };
    attribute(0, mesh.position, gl.UNSIGNED_SHORT);
    attribute(1, mesh.normal, gl.BYTE);
    attribute(2, mesh.color, gl.UNSIGNED_BYTE);
    gl.bindBuffer(gl.ARRAY_BUFFER, instances);
    for (const [place, size, offset] of [[3, 3, 0], [4, 4, 12], [5, 1, 28]]) {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, gl.FLOAT, false, 32, offset);
      gl.vertexAttribDivisor(place, 1);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, mesh.index, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    const type = mesh.index instanceof Uint32Array ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT;
    return { array, type, corners: mesh.index.length, low: mesh.low, size: mesh.size };
  }

  read(frame, x, y, width, height) {
    const gl = this.gl;
    const raw = new Uint8Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.readPixels(x, y, width, height, gl.RGBA, gl.UNSIGNED_BYTE, raw);
    return raw;
  }
}
