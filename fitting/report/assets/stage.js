// Draws ground and skeletons with WebGL 2.

const HIDDEN = 0.22; // strength of what is behind or in the ground
const FIELDS_OF_BONE = 11; // start, end, colour with opacity, radius

function addCapsule(fields, start, end, colour, opacity, radius) {
  fields.push(...start, ...end, ...colour, opacity, radius);
}

class Stage {
  constructor(canvas) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
    if (!this.gl) return;
    const gl = this.gl;
    this.groundProgram = this.program(GROUND_VERTICES, GROUND_COLOURS);
    this.boneProgram = this.program(BONE_VERTICES, BONE_COLOURS);
    this.bones = this.boneBuffers();
    this.shadowTexture = this.texture();
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

  attribute(program, name, size, stride = 0, offset = 0, perBone = 0) {
    const gl = this.gl;
    const place = program.attribute(name);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, gl.FLOAT, false, stride, offset);
    gl.vertexAttribDivisor(place, perBone);
  }

  boneBuffers() {
    const gl = this.gl;
    const { corners, triangles } = capsule();
    const vertices = gl.createVertexArray();
    gl.bindVertexArray(vertices);
    this.buffer(corners);
    this.attribute(this.boneProgram, "corner", 4);
    const instances = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, instances);
    const stride = 4 * FIELDS_OF_BONE;
    this.attribute(this.boneProgram, "start", 3, stride, 0, 1);
    this.attribute(this.boneProgram, "end", 3, stride, 12, 1);
    this.attribute(this.boneProgram, "tint", 4, stride, 24, 1);
    this.attribute(this.boneProgram, "radius", 1, stride, 40, 1);
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
  draw(skeletons, time, camera, palette, segments = []) {
    const gl = this.gl;
    const view = camera.matrix(this.resize());
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(...palette.sky, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.drawGround(skeletons, view, camera, palette);
    const opaqueFirst = [...skeletons].sort((a, b) => b.opacity - a.opacity);
    for (const skeleton of opaqueFirst) this.drawSkeleton(skeleton, time, view, camera, palette);
    this.drawCapsules(new Float32Array(segments), view, camera);
  }

  drawGround(skeletons, view, camera, palette) {
    const gl = this.gl, { program, uniform } = this.groundProgram, { ground } = this;
    gl.useProgram(program);
    gl.uniformMatrix4fv(uniform("view"), false, view);
    for (const name of ["low", "high", "grid", "sky"]) gl.uniform3fv(uniform(name), palette[name]);
    gl.uniform3fv(uniform("light"), LIGHT);
    gl.uniform3fv(uniform("target"), camera.target);
    gl.uniform2f(uniform("heights"), ground.lowest, ground.highest);
    gl.uniform1f(uniform("reach"), Math.max(6 * ground.size, 2.2 * camera.distance));
    gl.uniform1f(uniform("size"), ground.size);
    this.setShadows(skeletons.at(-1), uniform);
    gl.enable(gl.BLEND);
    gl.bindVertexArray(this.groundVertices);
    gl.drawElements(gl.TRIANGLES, ground.triangles.length, gl.UNSIGNED_INT, 0);
  }

  // All bones of a skeleton, if there is one, for the shader of the ground.
  setShadows(thrower, uniform) {
    const gl = this.gl;
    const bones = thrower?.bones ?? [];
    const points = new Float32Array(bones.flatMap(([a, b]) => [...thrower.point(a), 0, ...thrower.point(b), 0]));
    gl.bindTexture(gl.TEXTURE_2D, this.shadowTexture);
    if (bones.length) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 2, bones.length, 0, gl.RGBA, gl.FLOAT, points);
    gl.uniform1i(uniform("bones"), 0);
    gl.uniform1i(uniform("shadows"), bones.length);
    const [x, , z] = thrower ? thrower.point(thrower.pelvis) : [0, 0, 0];
    let reach = 0, highest = -Infinity;
    for (let i = 0; i < points.length; i += 4) {
      reach = Math.max(reach, Math.hypot(points[i] - x, points[i + 2] - z));
      highest = Math.max(highest, points[i + 1]);
    }
    const softness = 0.035 * this.ground.size + 0.09 * Math.max(highest - this.ground.lowest, 0);
    gl.uniform3f(uniform("middle"), x, z, reach + softness);
  }

  drawSkeleton(skeleton, time, view, camera, palette) {
    this.drawCapsules(this.instances(skeleton, skeleton.sunkLegs(time), palette), view, camera);
  }

  drawCapsules(instances, view, camera) {
    const gl = this.gl, { program, uniform } = this.boneProgram;
    gl.useProgram(program);
    gl.uniformMatrix4fv(uniform("view"), false, view);
    gl.uniform3fv(uniform("light"), LIGHT);
    gl.uniform3fv(uniform("eye"), camera.eye);
    gl.bindVertexArray(this.bones.vertices);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.bones.instances);
    gl.bufferData(gl.ARRAY_BUFFER, instances, gl.DYNAMIC_DRAW);
    const count = instances.length / FIELDS_OF_BONE;
    const drawBones = () =>
      gl.drawElementsInstanced(gl.TRIANGLES, this.bones.count, gl.UNSIGNED_SHORT, 0, count);
    gl.enable(gl.BLEND);
    gl.uniform1f(uniform("strength"), HIDDEN); // first what the ground hides
    gl.depthMask(false);
    gl.depthFunc(gl.GREATER);
    drawBones();
    gl.depthMask(true);
    gl.depthFunc(gl.LESS);
    gl.colorMask(false, false, false, false); // then depth alone: a shell shows no inner surface
    drawBones();
    gl.colorMask(true, true, true, true);
    gl.depthFunc(gl.LEQUAL);
    gl.uniform1f(uniform("strength"), 1);
    drawBones();
    gl.depthFunc(gl.LESS);
  }

  // Bones, soles and lines from the foot's joints to its sole, red where the foot is in the ground.
  instances(skeleton, sunk, palette) {
    const size = this.ground.size;
    const colour = palette[skeleton.key];
    const bones = [];
    const bone = (a, b, inGround, thickness = 1) => {
      const radius = size * skeleton.radius * thickness * (inGround ? 1.4 : 1);
      const opacity = inGround ? 1 : skeleton.opacity;
      bones.push(...skeleton.point(a), ...skeleton.point(b), ...(inGround ? palette.sunk : colour), opacity, radius);
    };
    for (const [a, b] of skeleton.bones) {
      const leg = skeleton.footBones.get(`${a}-${b}`);
      bone(a, b, leg !== undefined && sunk[leg]);
    }
    skeleton.soles.forEach(([heel, ball], leg) => {
      const [, , ankle, toe] = skeleton.legs[leg];
      bone(heel, ball, sunk[leg], 0.6);
      bone(ankle, heel, sunk[leg], 0.45);
      bone(toe, ball, sunk[leg], 0.45);
    });
    return new Float32Array(bones);
  }
}
