// Ties data, view and controls together. What tests read stands in the canvas's data attributes.

const element = (id) => document.getElementById(id);

function showFailure() {
  element("failure").hidden = false;
  for (const part of document.querySelectorAll(".controls, .options, .to-worst")) part.hidden = true;
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
    this.shown = new Set(["captured", "fitted"]);
    this.playing = false;
    this.time = 0; // frames
    this.stage = makeStage(this.canvas);
    if (!this.stage) return;
    this.canvas.addEventListener("webglcontextlost", showFailure);
    this.camera = new Camera(this.canvas, () => this.request());
    this.timeline = new Timeline(element("timeline"));
    this.readPalette();
    this.makeLegend();
    this.connect();
    this.setClip(0);
  }

  setClip(index) {
    this.index = index;
    this.clip = this.clips[index];
    this.skeletons = this.clip.skeletons.map((packed) => new Skeleton(packed, this.clip.legs.length));
    this.stage.setGround(new Ground(this.clip.ground, this.clip.size));
    element("time").max = this.clip.frames - 1;
    this.timeline.setClip(this.clip, this.skeletons.at(-1));
    this.seek(0);
    this.play(false);
    this.camera.setClip(this.clip, ...this.skeletons.at(-1).reach());
    this.camera.follow(this.pelvis());
  }

  makeLegend() {
    for (const { key, label } of this.clips[0].skeletons) {
      const box = Object.assign(document.createElement("input"), { type: "checkbox", checked: this.shown.has(key) });
      box.dataset.key = key;
      box.addEventListener("change", () => {
        this.shown[box.checked ? "add" : "delete"](key);
        this.request();
      });
      const swatch = document.createElement("span");
      swatch.className = "swatch";
      swatch.style.background = `var(--${key})`;
      const entry = document.createElement("label");
      entry.append(box, swatch, label);
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
    element("jump").addEventListener("click", () => this.showWorst());
    element("clip")?.addEventListener("change", (event) => this.setClip(Number(event.target.value)));
    for (const button of document.querySelectorAll("[data-view]")) {
      button.addEventListener("click", () => this.camera.show(button.dataset.view));
    }
    for (const button of document.querySelectorAll(".to-worst")) {
      button.addEventListener("click", () => {
        if (element("clip")) element("clip").value = button.dataset.clip;
        if (this.index !== Number(button.dataset.clip)) this.setClip(Number(button.dataset.clip));
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
    this.seek(this.clip.worst.start);
    this.play(true, this.clip.worst.end);
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

  pelvis() {
    const main = this.skeletons.at(-1);
    return main.point(main.pelvis);
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
    this.stage.draw(shown, this.time, this.camera, this.palette);
    this.describe(shown);
  }

  // In words, and for tests.
  describe(shown) {
    const fitted = this.skeletons.at(-1);
    const sunk = this.shown.has("fitted") ? fitted.sunkLegs(this.time) : [];
    const names = this.clip.legs.filter((_, leg) => sunk[leg]);
    element("alert").hidden = !names.length;
    element("alert").textContent = `${fitted.label}: ${names.join(", ")} sole in the ground`;
    const ankles = fitted.legs.map((joints) => fitted.point(joints[2]).map((value) => value.toFixed(4)));
    Object.assign(this.canvas.dataset, {
      frame: Math.round(this.time),
      clip: this.index,
      playing: this.playing,
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
    const colour = (name) => {
      const digits = style.getPropertyValue(name).trim().slice(1);
      return [0, 2, 4].map((at) => parseInt(digits.slice(at, at + 2), 16) / 255);
    };
    const light = (parts) => (dark ? parts.map((part) => part + 0.22 * (1 - part)) : parts);
    this.palette = {
      low: colour("--ground-low"), high: colour("--ground-high"), grid: colour("--grid"),
      sky: colour("--sky"), sunk: colour("--sunk"),
    };
    for (const key of Object.keys(LOOKS)) this.palette[key] = light(colour(`--${key}`));
  }
}

// Light or dark: as the system says, until the button is pressed; paper is always light.
function connectTheme(changed) {
  const system = matchMedia("(prefers-color-scheme: dark)");
  let chosen = null;
  const show = (theme) => {
    document.documentElement.dataset.theme = theme;
    element("theme").setAttribute("aria-label", theme === "dark" ? "Switch to light" : "Switch to dark");
    changed();
  };
  const current = () => chosen ?? (system.matches ? "dark" : "light");
  system.addEventListener("change", () => show(current()));
  element("theme").addEventListener("click", () => {
    chosen = current() === "dark" ? "light" : "dark";
    show(chosen);
  });
  addEventListener("beforeprint", () => show("light"));
  addEventListener("afterprint", () => show(current()));
  show(current());
}

let player = null;
connectTheme(() => {
  if (!player?.palette) return;
  player.readPalette();
  player.frame(performance.now());
  player.drawStill();
});
player = new Player(JSON.parse(element("data").textContent).clips);
