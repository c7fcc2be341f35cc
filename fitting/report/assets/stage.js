// Draws ground and bodies with WebGL 2.

const HIDDEN = 0.22; // strength of what is behind or in the ground
const SWELLING = 0.06; // m, of an adult's mesh that is twice as thick
const LAYOUT = [["start", 3], ["end", 3], ["tint", 4], ["radii", 3], ["across", 3], ["more", 2]]; // of instances

class Stage {
  constructor(canvas) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
    if (!this.gl) return;
    const gl = this.gl;
    this.groundProgram = this.program(GROUND_VERTICES, GROUND_COLOURS);
    this.bodyProgram = this.program(BODY_VERTICES, BODY_COLOURS);
    this.limbs = this.bodyBuffers(capsule());
    this.slabs = this.bodyBuffers(slab());
    this.skinProgram = this.program(SKIN_VERTICES, BODY_COLOURS);
    this.shadowTexture = this.texture();
    this.slotTexture = this.texture();
    this.skinBuffers = new Map();
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  program(vertices, colours) {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertices], [gl.FRAGMENT_SHADER, colours]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
      const reasons = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
      throw new Error([gl.getProgramInfoLog(program), ...reasons].join("\n"));
    }
    const places = new Map();
    const uniform = (name) => {
      if (!places.has(name)) places.set(name, gl.getUniformLocation(program, name));
      return places.get(name);
    };
    return { program, uniform, attribute: (name) => gl.getAttribLocation(program, name) };
  }

  buffer(content, kind = this.gl.ARRAY_BUFFER) {
    const buffer = this.gl.createBuffer();
    this.gl.bindBuffer(kind, buffer);
    this.gl.bufferData(kind, content, this.gl.STATIC_DRAW);
    return buffer;
  }

  attribute(program, name, size, stride = 0, offset = 0, perInstance = 0) {
    const gl = this.gl;
    const place = program.attribute(name);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, gl.FLOAT, false, 4 * stride, 4 * offset);
    gl.vertexAttribDivisor(place, perInstance);
  }

  bodyBuffers({ vertices: corners, triangles }) {
    const gl = this.gl;
    const vertices = gl.createVertexArray();
    gl.bindVertexArray(vertices);
    this.buffer(corners);
    this.attribute(this.bodyProgram, "corner", 4, 7);
    this.attribute(this.bodyProgram, "facing", 3, 7, 4);
    const instances = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, instances);
    let offset = 0;
    for (const [name, size] of LAYOUT) {
      this.attribute(this.bodyProgram, name, size, FIELDS, offset, 1);
      offset += size;
    }
    this.buffer(triangles, gl.ELEMENT_ARRAY_BUFFER);
    return { vertices, instances, count: triangles.length };
  }

  texture() {
    const gl = this.gl;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
      gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    }
    return texture;
  }

  setGround(ground) {
    const gl = this.gl;
    this.ground = ground;
    gl.deleteVertexArray(this.groundVertices ?? null);
    for (const buffer of this.groundBuffers ?? []) gl.deleteBuffer(buffer);
    for (const { vertices, buffers } of this.skinBuffers.values()) {
      gl.deleteVertexArray(vertices);
      for (const buffer of buffers) gl.deleteBuffer(buffer);
    }
    this.skinBuffers.clear(); // another clip may have other characters
    this.groundBuffers = [];
    this.groundVertices = gl.createVertexArray();
    gl.bindVertexArray(this.groundVertices);
    this.groundBuffers.push(this.buffer(ground.positions));
    this.attribute(this.groundProgram, "position", 3);
    this.groundBuffers.push(this.buffer(ground.normals));
    this.attribute(this.groundProgram, "normal", 3);
    this.groundBuffers.push(this.buffer(ground.margins));
    this.attribute(this.groundProgram, "margin", 1);
    this.groundBuffers.push(this.buffer(ground.triangles, gl.ELEMENT_ARRAY_BUFFER));
  }

  resize() {
    if (!this.canvas.clientWidth) return this.canvas.width / this.canvas.height; // on paper
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
    return width / height;
  }

  // Draws posed skeletons, the one that throws the shadow last; `palette` has colours of 0 to 1 by name.
  // `segments` are further capsules: start, end, colour, opacity and radius of each.
  draw(skeletons, time, camera, palette, segments = null) {
    const gl = this.gl;
    const view = camera.matrix(this.resize());
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(...palette.sky, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const figures = skeletons.map((skeleton) => figure(skeleton, time, palette, this.ground.size));
    this.drawGround(skeletons.at(-1), figures.at(-1), view, camera, palette);
    const opaqueFirst = figures.map((_, i) => i).sort((a, b) => skeletons[b].opacity - skeletons[a].opacity);
    for (const i of opaqueFirst) {
      if (skeletons[i].skin) this.drawSkin(skeletons[i], time, view, camera, palette);
      else this.drawFigure(figures[i], view, camera);
    }
    if (segments?.length) {
      const capsules = new Instances();
      capsules.addSegments(segments);
      this.drawFigure(capsules, view, camera);
    }
  }

  drawGround(thrower, body, view, camera, palette) {
    const gl = this.gl, { program, uniform } = this.groundProgram, { ground } = this;
    gl.useProgram(program);
    gl.uniformMatrix4fv(uniform("view"), false, view);
    for (const name of ["low", "high", "grid", "sky"]) gl.uniform3fv(uniform(name), palette[name]);
    gl.uniform3fv(uniform("light"), LIGHT);
    gl.uniform3fv(uniform("target"), camera.target);
    gl.uniform2f(uniform("heights"), ground.lowest, ground.highest);
    gl.uniform1f(uniform("reach"), Math.max(6 * ground.size, 2.2 * camera.distance));
    gl.uniform1f(uniform("size"), ground.size);
    this.setShadows(thrower, body, uniform);
    gl.enable(gl.BLEND);
    gl.bindVertexArray(this.groundVertices);
    gl.drawElements(gl.TRIANGLES, ground.triangles.length, gl.UNSIGNED_INT, 0);
  }

  // The limbs of a skeleton, if there is one, for the shader of the ground.
  setShadows(thrower, body, uniform) {
    const gl = this.gl;
    const limbs = body?.limbs ?? [], count = limbs.length / FIELDS;
    const points = new Float32Array(8 * count);
    for (let i = 0; i < count; i++) {
      const at = FIELDS * i;
      points.set([...limbs.slice(at, at + 3), 0.7 * limbs[at + 11], ...limbs.slice(at + 3, at + 6), 0], 8 * i);
    }
    gl.bindTexture(gl.TEXTURE_2D, this.shadowTexture);
    if (count) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 2, count, 0, gl.RGBA, gl.FLOAT, points);
    gl.uniform1i(uniform("limbs"), 0);
    gl.uniform1i(uniform("shadows"), count);
    const [x, , z] = thrower ? thrower.point(thrower.pelvis) : [0, 0, 0];
    let reach = 0, highest = -Infinity;
    for (let i = 0; i < points.length; i += 4) {
      reach = Math.max(reach, Math.hypot(points[i] - x, points[i + 2] - z));
      highest = Math.max(highest, points[i + 1]);
    }
    const softness = 0.12 * this.ground.size + 0.09 * Math.max(highest - this.ground.lowest, 0);
    gl.uniform3f(uniform("middle"), x, z, reach + softness);
  }

  drawFigure(figure, view, camera) {
    const gl = this.gl, program = this.bodyProgram;
    const kinds = [[this.limbs, figure.limbs, 0], [this.slabs, figure.slabs, 1]];
    for (const [buffers, numbers] of kinds) {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffers.instances);
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(numbers), gl.DYNAMIC_DRAW);
    }
    this.drawBody(program, view, camera, () => {
      for (const [{ vertices, count }, numbers, isSlab] of kinds) {
        if (!numbers.length) continue;
        gl.uniform1i(program.uniform("isSlab"), isSlab);
        gl.bindVertexArray(vertices);
        gl.drawElementsInstanced(gl.TRIANGLES, count, gl.UNSIGNED_SHORT, 0, numbers.length / FIELDS);
      }
    });
  }

  // The mesh of a skeleton that has one.
  drawSkin(skeleton, time, view, camera, palette) {
    const gl = this.gl, program = this.skinProgram, { uniform } = program, { skin } = skeleton;
    if (!this.skinBuffers.has(skin)) this.skinBuffers.set(skin, this.makeSkinBuffers(skin));
    const texels = skin.texels(skeleton, time);
    gl.bindTexture(gl.TEXTURE_2D, this.slotTexture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 4, texels.length / 16, 0, gl.RGBA, gl.FLOAT, texels);
    gl.useProgram(program.program);
    gl.uniform1i(uniform("slots"), 0);
    gl.uniform1i(uniform("isSkin"), 1);
    gl.uniform3fv(uniform("sunk"), palette.sunk);
    gl.uniform4fv(uniform("tint"), [...palette[skeleton.key], skeleton.opacity]);
    gl.uniform1f(uniform("swelling"), SWELLING * (skeleton.thickness - 1) * this.ground.size);
    const wide = skin.triangles instanceof Uint16Array ? gl.UNSIGNED_SHORT : gl.UNSIGNED_INT;
    this.drawBody(program, view, camera, () => {
      gl.bindVertexArray(this.skinBuffers.get(skin).vertices);
      gl.drawElements(gl.TRIANGLES, skin.triangles.length, wide, 0);
    });
  }

  makeSkinBuffers(skin) {
    const gl = this.gl, vertices = gl.createVertexArray();
    const stride = SKIN_FIELDS.reduce((sum, [, size]) => sum + size, 0);
    gl.bindVertexArray(vertices);
    const buffers = [this.buffer(skin.vertices)];
    let offset = 0;
    for (const [name, size] of SKIN_FIELDS) {
      this.attribute(this.skinProgram, name, size, stride, offset);
      offset += size;
    }
    buffers.push(this.buffer(skin.triangles, gl.ELEMENT_ARRAY_BUFFER));
    return { vertices, buffers };
  }

  drawBody({ program, uniform }, view, camera, drawAll) {
    const gl = this.gl;
    gl.useProgram(program);
    gl.uniformMatrix4fv(uniform("view"), false, view);
    gl.uniform3fv(uniform("light"), LIGHT);
    gl.uniform3fv(uniform("eye"), camera.eye);
    gl.enable(gl.BLEND);
    gl.enable(gl.CULL_FACE);
    gl.uniform1f(uniform("strength"), HIDDEN); // first what the ground hides
    gl.depthMask(false);
    gl.depthFunc(gl.GREATER);
    drawAll();
    gl.depthMask(true);
    gl.depthFunc(gl.LESS);
    gl.colorMask(false, false, false, false); // then depth alone: a shell shows no inner surface
    drawAll();
    gl.colorMask(true, true, true, true);
    gl.depthFunc(gl.LEQUAL);
    gl.uniform1f(uniform("strength"), 1);
    drawAll();
    gl.depthFunc(gl.LESS);
    gl.disable(gl.CULL_FACE);
  }
}
