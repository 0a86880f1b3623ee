// Thin wrappers of WebGL objects: programs, textures, framebuffers.

class Program {
  constructor(gl, vertex, fragment) {
    this.gl = gl;
    this.program = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(this.program, shader);
    }
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(this.program));
    this.uniforms = new Map();
    const count = gl.getProgramParameter(this.program, gl.ACTIVE_UNIFORMS);
    for (let k = 0, unit = 0; k < count; k++) {
      const { name, type } = gl.getActiveUniform(this.program, k);
      const texture = type === gl.SAMPLER_2D || type === gl.SAMPLER_2D_SHADOW;
      const place = gl.getUniformLocation(this.program, name);
      this.uniforms.set(name, { place, type, unit: texture ? unit++ : -1 });
    }
  }

  use(values) {
    this.gl.useProgram(this.program);
    return this.set(values);
  }

  // Set uniforms by name; names that the program does not have are passed over.
  set(values) {
    const gl = this.gl;
    for (const [name, value] of Object.entries(values)) {
      const uniform = this.uniforms.get(name);
      if (!uniform) continue;
      if (uniform.unit >= 0) {
        gl.activeTexture(gl.TEXTURE0 + uniform.unit);
        gl.bindTexture(gl.TEXTURE_2D, value);
        gl.uniform1i(uniform.place, uniform.unit);
      } else if (uniform.type === gl.FLOAT_MAT4) gl.uniformMatrix4fv(uniform.place, false, value);
      else if (uniform.type === gl.FLOAT_VEC4) gl.uniform4fv(uniform.place, value);
      else if (uniform.type === gl.FLOAT_VEC3) gl.uniform3fv(uniform.place, value);
      else if (uniform.type === gl.BOOL) gl.uniform1i(uniform.place, value ? 1 : 0);
      else gl.uniform1f(uniform.place, value);
    }
    return this;
  }
}

function makeTexture(gl, format, width, height) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
  for (const size of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, size, gl.NEAREST);
  return texture;
}

function makeFrame(gl, { image, depth }) {
  const frame = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  if (image) gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, image, 0);
  if (depth) gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depth, 0);
  return frame;
}

// What an image is painted through: a multisampled frame, the same resolved, its occlusion, a picking image.
class Target {
  constructor(gl) {
    this.gl = gl;
    this.width = this.height = 0;
    this.release = [];
  }

  resize(width, height) {
    if (width === this.width && height === this.height) return;
    const gl = this.gl;
    this.release.forEach((drop) => drop());
    this.release = [];
    [this.width, this.height] = [width, height];
    this.many = this.multisampled();
    this.single = this.frame({ image: gl.RGBA8, depth: gl.DEPTH_COMPONENT24 });
    this.shade = this.frame({ image: gl.RGBA8 });
    this.output = this.frame({ image: gl.RGBA8 });
    this.pick = this.frame({ image: gl.RGBA8, depth: gl.DEPTH_COMPONENT24 });
  }

  // Copy the multisampled frame into the single one: colors averaged, one depth per pixel.
  resolve() {
    const gl = this.gl;
    const [w, h] = [this.width, this.height];
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.many.frame);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, this.single.frame);
    gl.blitFramebuffer(0, 0, w, h, 0, 0, w, h, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    gl.blitFramebuffer(0, 0, w, h, 0, 0, w, h, gl.DEPTH_BUFFER_BIT, gl.NEAREST);
  }

  frame(formats) {
    const gl = this.gl;
    const textures = {};
    for (const [name, format] of Object.entries(formats)) {
      const texture = makeTexture(gl, format, this.width, this.height);
      textures[name] = texture;
      this.release.push(() => gl.deleteTexture(texture));
    }
    const frame = makeFrame(gl, textures);
    this.release.push(() => gl.deleteFramebuffer(frame));
    return { ...textures, frame };
  }

  multisampled() {
    const gl = this.gl;
    const samples = Math.min(4, gl.getParameter(gl.MAX_SAMPLES));
    const frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    for (const [place, format] of [[gl.COLOR_ATTACHMENT0, gl.RGBA8], [gl.DEPTH_ATTACHMENT, gl.DEPTH_COMPONENT24]]) {
      const buffer = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
      gl.renderbufferStorageMultisample(gl.RENDERBUFFER, samples, format, this.width, this.height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, place, gl.RENDERBUFFER, buffer);
      this.release.push(() => gl.deleteRenderbuffer(buffer));
    }
    this.release.push(() => gl.deleteFramebuffer(frame));
    return { frame };
  }
}
