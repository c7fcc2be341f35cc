// Ties data, view and controls together. What tests read stands in the canvas's data attributes.

function showFailure() {
  element("failure").hidden = false;
  for (const part of document.querySelectorAll(".controls, .options, .live, .to-worst")) part.hidden = true;
}

// What draws, or null where the browser cannot.
function makeStage(canvas) {
  try {
    const stage = new Stage(canvas);
    if (stage.gl) return stage;
  } catch (error) {
    console.warn(error);
  }
  showFailure();
  return null;
}

function make(name, properties = {}, ...children) {
  const node = Object.assign(document.createElement(name), properties);
  node.append(...children);
  return node;
}

function swatch({ colour }) {
  const mark = make("span", { className: "swatch" });
  mark.style.background = colour;
  return mark;
}

class Player {
  // `program` serves the page, and has those of its `clips` that are null; or it is null.
  constructor(clips, program) {
    this.clips = clips;
    this.program = program;
    this.canvas = element("view");
    const visible = clips.flatMap((clip) => clip?.skeletons ?? []).filter((skeleton) => skeleton.visible);
    this.shown = new Set(visible.map((skeleton) => skeleton.key));
    this.playing = false;
    this.time = 0; // frames
    this.stage = makeStage(this.canvas);
    if (!this.stage) return;
    this.canvas.addEventListener("webglcontextlost", showFailure);
    this.camera = new Camera(this.canvas, () => this.request());
    this.timeline = new Timeline(element("timeline"));
    this.curves = new Curves(element("curves"));
    this.figures = new FigureTable(this);
    this.overlays = new Layers(this);
    this.contacts = program && new ContactEditor(this);
    this.connect();
    this.setClip(0);
  }

  // Shows another clip, once it is here.
  async choose(index) {
    this.wanted = index;
    this.clips[index] ??= await this.program.clip(index);
    if (this.wanted === index) this.setClip(index);
  }

  replaceClip(index, clip) {
    this.clips[index] = clip;
    const { time } = this;
    this.setClip(index);
    this.seek(Math.min(time, clip.frames - 1));
  }

  setClip(index) {
    this.index = index;
    this.clip = this.clips[index];
    this.readPalette();
    this.overlays.take(null);
    this.skeletons = this.clip.skeletons.map((packed) => new Skeleton(packed, this.clip.legs.length, this.clip.visibleDepth));
    this.measuring = new Measuring(this.clip, this.skeletons);
    this.editor = this.contacts?.setClip() ?? null;
    this.stage.setGround(new Ground(this.clip.ground, this.clip.size));
    element("time").max = this.clip.frames - 1;
    this.makeLegend();
    this.watch(this.watched?.key ?? this.clip.watched);
    this.seek(0);
    this.play(false);
    this.camera.setClip(this.clip, ...this.watched.reach());
    this.camera.follow(this.pelvis());
    this.live?.setClip();
  }

  // What the marks over the slider, the red feet's label, the shadow and the camera belong to.
  watch(key) {
    const candidates = this.skeletons.filter((skeleton) => skeleton.key !== "captured");
    this.watched = candidates.find((skeleton) => skeleton.key === key) ?? candidates[0];
    const choice = element("watched");
    choice.replaceChildren(...candidates.map(({ key, label }) => new Option(label, key)));
    choice.value = this.watched.key;
    choice.parentElement.hidden = candidates.length < 2;
    this.shown.add(this.watched.key);
    for (const box of element("legend").querySelectorAll("input")) box.checked = this.shown.has(box.dataset.key);
    this.timeline.setClip(this.clip, this.watched, this.editor);
    this.timeline.point(this.time);
    this.curves.show(this);
    this.figures.show();
    element("jump").hidden = !this.watched.worst;
    this.live?.watch(this.watched.key);
    this.request();
  }

  makeLegend() {
    element("legend").replaceChildren();
    for (const skeleton of this.skeletons) {
      const { key, label, solution } = skeleton;
      const box = make("input", { type: "checkbox", checked: this.shown.has(key) });
      box.dataset.key = key;
      box.addEventListener("change", () => {
        this.shown[box.checked ? "add" : "delete"](key);
        this.request();
      });
      element("legend").append(make("label", {}, box, swatch(skeleton), solution ? `${label}, live` : label));
    }
  }

  connect() {
    element("play").addEventListener("click", () => this.play(!this.playing));
    element("time").addEventListener("input", (event) => {
      this.play(false);
      this.seek(Number(event.target.value));
    });
    element("follow").addEventListener("change", () => this.request());
    element("watched").addEventListener("change", (event) => this.watch(event.target.value));
    element("jump").addEventListener("click", () => this.showWorst());
    element("clip")?.addEventListener("change", (event) => this.choose(Number(event.target.value)));
    for (const button of document.querySelectorAll("[data-view]")) {
      button.addEventListener("click", () => this.camera.show(button.dataset.view));
    }
    for (const button of document.querySelectorAll(".to-worst")) {
      button.addEventListener("click", () => {
        if (element("clip")) element("clip").value = button.dataset.clip;
        if (this.index !== Number(button.dataset.clip)) this.setClip(Number(button.dataset.clip));
        if (button.dataset.key) this.watch(button.dataset.key);
        this.showWorst();
        const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
        element("motion").scrollIntoView({ behavior: still ? "auto" : "smooth" });
      });
    }
    this.canvas.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return; // keys of the browser
      if (event.key === " ") event.repeat || this.play(!this.playing);
      else if (!this.camera.key(event.key)) return;
      event.preventDefault();
    });
    new ResizeObserver(() => {
      this.timeline.drawAll();
      this.timeline.point(this.time);
      this.curves.draw();
      this.request();
    }).observe(this.canvas);
  }

  showWorst() {
    this.play(false);
    this.seek(this.watched.worst.start);
    this.play(true, this.watched.worst.end);
  }

  // Goes to a frame and stays there.
  jump(frame) {
    this.play(false);
    this.seek(frame);
    element("time").focus({ preventScroll: true });
  }

  // Plays to the last frame, or to another one.
  play(playing, until = this.clip.frames - 1) {
    this.playing = playing;
    this.until = until;
    if (playing && this.time >= until) this.seek(0);
    element("play").textContent = playing ? "❚❚" : "▶";
    element("play").setAttribute("aria-label", playing ? "Pause" : "Play");
    this.before = null;
    this.request();
  }

  seek(time) {
    this.time = time;
    const slider = element("time");
    slider.value = Math.round(time);
    const seconds = time / this.clip.rate;
    const all = (this.clip.frames - 1) / this.clip.rate;
    slider.setAttribute("aria-valuetext", `${seconds.toFixed(2)} of ${all.toFixed(2)} seconds`);
    element("clock").textContent = `${seconds.toFixed(2)} / ${all.toFixed(2)} s`;
    for (const skeleton of this.skeletons) skeleton.pose(time);
    this.timeline.point(time);
    this.curves.point(time);
    this.request();
  }

  get layers() {
    return this.overlays.names;
  }

  // Draws another motion of a skeleton, or its own again; `layers` are those of a solution.
  show(skeleton, solution, layers = null) {
    this.overlays.take(layers);
    const isNew = !skeleton.solution !== !solution;
    skeleton.show(solution);
    if (isNew) this.makeLegend();
    skeleton.pose(this.time);
    this.timeline.drawAll();
    this.timeline.point(this.time);
    this.curves.show(this);
    this.figures.show();
    this.request();
  }

  pelvis() {
    return this.watched.point(this.watched.pelvis);
  }

  request() {
    this.requested ??= requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    cancelAnimationFrame(this.requested);
    this.requested = null;
    if (this.playing) {
      if (this.before !== null) {
        const speed = Number(element("speed").value);
        const time = this.time + (Math.max(now - this.before, 0) / 1000) * speed * this.clip.rate;
        this.seek(Math.min(time, this.until));
        if (time >= this.until) this.play(false);
      }
      this.before = now;
      this.request();
    }
    if (element("follow").checked) this.camera.follow(this.pelvis());
    const shown = this.skeletons.filter((skeleton) => this.shown.has(skeleton.key));
    shown.sort((a, b) => (a === this.watched) - (b === this.watched)); // it throws the shadow
    this.stage.draw(shown, this.time, this.camera, this.palette, this.overlays.capsules(this.time));
    this.describe(shown);
  }

  // In words, and for tests.
  describe(shown) {
    const { watched } = this;
    const sunk = shown.includes(watched) ? watched.sunkLegs(this.time) : [];
    const names = this.clip.legs.filter((_, leg) => sunk[leg]);
    element("alert").hidden = !names.length;
    element("alert").textContent = `${watched.label}: ${names.join(", ")} sole in the ground`;
    const ankles = watched.legs.map((joints) => watched.point(joints[2]).map((value) => value.toFixed(4)));
    Object.assign(this.canvas.dataset, {
      frame: Math.round(this.time),
      clip: this.index,
      playing: this.playing,
      watched: watched.key,
      shown: shown.map((skeleton) => skeleton.key).join(" "),
      ankles: ankles.map((point) => point.join(",")).join(" "),
    });
  }

  // What is shown, for paper: printers may miss what WebGL draws.
  drawStill() {
    const still = element("still");
    still.width = this.canvas.width;
    still.height = this.canvas.height;
    still.getContext("2d").drawImage(this.canvas, 0, 0);
  }

  readPalette() {
    const style = getComputedStyle(document.documentElement);
    const dark = document.documentElement.dataset.theme === "dark";
    const parts = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255);
    const colour = (name) => parts(style.getPropertyValue(name).trim());
    const light = (rgb) => (dark ? rgb.map((part) => part + 0.22 * (1 - part)) : rgb);
    this.palette = {
      low: colour("--ground-low"), high: colour("--ground-high"), grid: colour("--grid"),
      sky: colour("--sky"), sunk: colour("--sunk"), sliding: colour("--sliding"),
    };
    for (const { key, colour: hex } of this.clips.flatMap((clip) => clip?.skeletons ?? [])) {
      this.palette[key] = light(parts(hex));
    }
  }
}
