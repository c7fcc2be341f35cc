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

class Player {
  constructor(clips) {
    this.clips = clips;
    this.canvas = element("view");
    const visible = clips.flatMap((clip) => clip.skeletons).filter((skeleton) => skeleton.visible);
    this.shown = new Set(visible.map((skeleton) => skeleton.key));
    this.playing = false;
    this.time = 0; // frames
    this.stage = makeStage(this.canvas);
    if (!this.stage) return;
    this.canvas.addEventListener("webglcontextlost", showFailure);
    this.camera = new Camera(this.canvas, () => this.request());
    this.timeline = new Timeline(element("timeline"));
    this.readPalette();
    this.connect();
    this.setClip(0);
  }

  setClip(index) {
    this.index = index;
    this.clip = this.clips[index];
    this.skeletons = this.clip.skeletons.map((packed) => new Skeleton(packed, this.clip.legs.length, this.clip.visibleDepth));
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
    const candidates = this.skeletons.filter((skeleton) => skeleton.worst);
    this.watched = candidates.find((skeleton) => skeleton.key === key) ?? candidates[0];
    const choice = element("watched");
    choice.replaceChildren(...candidates.map(({ key, label }) => new Option(label, key)));
    choice.value = this.watched.key;
    choice.parentElement.hidden = candidates.length < 2;
    this.shown.add(this.watched.key);
    for (const box of element("legend").querySelectorAll("input")) box.checked = this.shown.has(box.dataset.key);
    this.timeline.setClip(this.clip, this.watched);
    this.timeline.point(this.time);
    this.live?.watch(this.watched.key);
    this.request();
  }

  makeLegend() {
    element("legend").replaceChildren();
    for (const { key, label, colour, solution } of this.skeletons) {
      const box = Object.assign(document.createElement("input"), { type: "checkbox", checked: this.shown.has(key) });
      box.dataset.key = key;
      box.addEventListener("change", () => {
        this.shown[box.checked ? "add" : "delete"](key);
        this.request();
      });
      const swatch = document.createElement("span");
      swatch.className = "swatch";
      swatch.style.background = colour;
      const entry = document.createElement("label");
      entry.append(box, swatch, solution ? `${label}, live` : label);
      element("legend").append(entry);
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
    element("clip")?.addEventListener("change", (event) => this.setClip(Number(event.target.value)));
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
      this.request();
    }).observe(this.canvas);
  }

  showWorst() {
    this.play(false);
    this.seek(this.watched.worst.start);
    this.play(true, this.watched.worst.end);
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
    this.request();
  }

  // Draws another motion of a skeleton, or its own again.
  show(skeleton, solution) {
    const isNew = !skeleton.solution !== !solution;
    skeleton.show(solution);
    if (isNew) this.makeLegend();
    skeleton.pose(this.time);
    this.timeline.drawAll();
    this.timeline.point(this.time);
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
    this.stage.draw(shown, this.time, this.camera, this.palette);
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
      sky: colour("--sky"), sunk: colour("--sunk"),
    };
    for (const { key, colour: hex } of this.clips.flatMap((clip) => clip.skeletons)) {
      this.palette[key] = light(parts(hex));
    }
  }
}

const player = new Player(JSON.parse(element("data").textContent).clips);
onTheme(() => {
  if (!player.palette) return;
  player.readPalette();
  player.frame(performance.now());
  player.drawStill();
});
