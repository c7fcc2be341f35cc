// Sliders of parameters: a worker solves the clip again, and its motion is drawn instead.

// Bytes that live_data.py has compressed.
async function unpacked(text) {
  const stream = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}
const doubles = async (text) => new Float64Array(await unpacked(text));

// A table of so many columns, row by row, of which live_data.py has packed 6 bytes of each number.
async function table(text, columns) {
  const planes = new Uint8Array(await unpacked(text)), count = planes.length / 6, rows = count / columns;
  const bytes = new Uint8Array(8 * count);
  for (let i = 0; i < planes.length; i++) {
    const place = i % count, row = place % rows, column = (place - row) / rows;
    bytes[8 * (row * columns + column) + 2 + (i - place) / count] = planes[i];
  }
  return new Float64Array(bytes.buffer);
}
const integers = async (text) => new Uint32Array(await unpacked(text));

const shownNumber = (value) => (Number.isFinite(value) ? String(Number(value.toPrecision(4))) : value > 0 ? "∞" : "-∞");

function make(name, properties = {}, ...children) {
  const element = Object.assign(document.createElement(name), properties);
  element.append(...children);
  return element;
}

class LivePanel {
  constructor(player, clips) {
    this.player = player;
    this.scripts = Object.assign({}, ...clips.map((clip) => clip.live?.scripts));
    this.panel = element("live");
    this.panel.addEventListener("toggle", () => this.panel.open && this.open());
    element("live-system").addEventListener("change", (event) => this.player.watch(event.target.value));
    this.setClip();
  }

  // The panel of the clip that is shown, or why there is none.
  setClip() {
    this.close();
    this.live = this.player.clip.live;
    this.panel.hidden = !this.live?.systems;
    element("live-reason").hidden = !this.live?.reason;
    element("live-reason").textContent = this.live?.reason ? `No live parameters here: ${this.live.reason}.` : "";
    if (!this.panel.hidden && this.panel.open) this.open();
  }

  close() {
    this.say("");
    this.worker?.terminate();
    this.worker = this.system = null;
  }

  // Goes on with another system, if it is one that is now watched.
  watch(key) {
    if (!this.system || this.system.key === key) return;
    if (this.live.systems.some((system) => system.key === key)) this.begin(key);
  }

  open() {
    if (this.system) return;
    const { systems } = this.live;
    const labels = new Map(this.player.skeletons.map(({ key, label }) => [key, label]));
    const choice = element("live-system");
    choice.replaceChildren(...systems.map(({ key }) => new Option(labels.get(key), key)));
    choice.parentElement.hidden = systems.length < 2;
    const watched = systems.find(({ key }) => key === this.player.watched.key);
    this.begin((watched ?? systems[0]).key);
  }

  // Makes the sliders of a system and a worker that solves it.
  async begin(key) {
    if (this.skeleton?.solution) this.player.show(this.skeleton, null);
    this.close();
    const system = this.live.systems.find((system) => system.key === key);
    this.system = system;
    element("live-system").value = key;
    this.skeleton = this.player.skeletons.find((skeleton) => skeleton.key === key);
    this.say("Preparing ...");
    try {
      const names = Object.keys(system.starts);
      const starts = await Promise.all(names.map((name) => doubles(system.starts[name])));
      if (this.system !== system) return;
      this.starts = new Map(names.map((name, i) => [name, starts[i]]));
      this.parameters = starts[0].slice();
      this.makeControls();
      const worker = await this.makeWorker(system);
      if (this.system !== system) return worker.terminate();
      this.worker = worker;
      this.busy = false;
      this.send();
    } catch (error) {
      this.say(`This browser cannot solve the motion: ${error.message}`);
    }
  }

  async makeWorker(system) {
    const { live, player } = this, script = this.scripts[system.script];
    const [code, numbers, measures, observed] = await Promise.all([
      unpacked(script.code), table(live.numbers, live.columns), doubles(live.measures), unpacked(live.observed),
    ]);
    const surfaces = await Promise.all(live.surfaces.map(async (surface) => {
      if (surface.kind === "Heights") return { ...surface, heights: await table(surface.heights, surface.columns) };
      if (surface.kind !== "Mesh") return surface;
      const [vertices, triangles, layers] = await Promise.all([table(surface.vertices, 3), integers(surface.triangles), integers(surface.layers)]);
      return { ...surface, vertices, triangles, layers };
    }));
    const [first] = player.skeletons; // the animation, whose joints move with the solved ones
    const animated = Float32Array.from({ length: 3 * first.points * player.clip.frames }, (_, i) =>
      first.at(Math.floor(i / (3 * first.points)), i % (3 * first.points)),
    );
    const address = URL.createObjectURL(new Blob([code], { type: "text/javascript" }));
    const worker = new Worker(address);
    const ifCurrent = (act) => (event) => worker === this.worker && act(event); // an ended one may still say something
    worker.onmessage = ifCurrent((event) => this.receive(event.data));
    worker.onerror = ifCurrent((event) => this.say(`This browser cannot solve the motion: ${event.message}`));
    const { frames, step, columns, anchors, reach } = live, { pelvis, soles } = first, { layout } = script, { trunk } = system;
    worker.postMessage({ clip: {
      frames, step, columns, anchors, reach, pelvis, soles, layout, trunk, numbers, measures, surfaces, animated,
      observed: new Uint8Array(observed),
    } });
    return worker;
  }

  makeControls() {
    const groups = new Map();
    for (const slider of this.system.sliders) {
      const group = slider.free ? "Fitted" : slider.leaf.split(".")[0];
      groups.set(group, [...(groups.get(group) ?? []), slider]);
    }
    const fitted = groups.get("Fitted");
    groups.delete("Fitted");
    const ordered = fitted ? [["Fitted", fitted], ...groups] : [...groups];
    this.controls = [];
    element("live-sliders").replaceChildren(...ordered.map(([name, sliders], number) =>
      make("details", { open: number === 0, className: "group" },
        make("summary", {}, name), ...sliders.map((slider) => this.makeControl(slider))),
    ));
    element("live-starts").replaceChildren(...[...this.starts].map(([name, values]) => {
      const button = make("button", { type: "button" }, name);
      button.addEventListener("click", () => {
        this.parameters.set(values);
        this.update();
      });
      return button;
    }));
    this.refresh();
  }

  makeControl(slider) {
    const id = `live-${this.controls.length}`;
    const input = slider.switch
      ? make("input", { id, type: "checkbox", autocomplete: "off" })
      : make("input", { id, type: "range", autocomplete: "off", min: slider.low, max: slider.high, step: slider.step });
    const output = make("output", { htmlFor: id });
    input.addEventListener("input", () => {
      this.parameters[slider.at] = slider.switch ? Number(input.checked) : this.inOrder(slider, Number(input.value));
      this.update();
    });
    const unit = slider.unit === "1" ? "" : ` ${slider.unit}`;
    const range = slider.switch ? "" : ` ${shownNumber(slider.low)} to ${shownNumber(slider.high)}${unit}.`;
    input.setAttribute("aria-describedby", `${id}-meaning`);
    const row = make("div", { className: "slider" },
      make("label", { htmlFor: id }, make("code", {}, slider.name)), input, output,
      make("small", { id: `${id}-meaning` }, slider.meaning + range),
    );
    this.controls.push({ slider, input, output, row, unit });
    return row;
  }

  // A value no further than the order of parameters allows.
  inOrder({ above, below }, value) {
    for (const [start, end] of below) value = Math.min(value, ...this.parameters.subarray(start, end));
    return above.length ? Math.max(value, ...this.parameters.subarray(...above)) : value;
  }

  get original() {
    return this.starts.values().next().value;
  }

  get isChanged() {
    return this.parameters.some((value, i) => value !== this.original[i]);
  }

  // After a change of parameters: what the panel shows, and soon the motion.
  update() {
    this.refresh();
    this.isWanted = true;
    this.requested ??= requestAnimationFrame(() => {
      this.requested = null;
      if (this.worker && !this.busy) this.send();
    });
  }

  refresh() {
    const changes = [];
    for (const { slider, input, output, row, unit } of this.controls) {
      const value = this.parameters[slider.at];
      const text = slider.switch ? (value ? "on" : "off") : shownNumber(value) + unit;
      if (slider.switch) input.checked = value > 0;
      else {
        input.value = Math.min(Math.max(value, slider.low), slider.high); // it may be infinite
        input.setAttribute("aria-valuetext", text);
      }
      output.textContent = text;
      const isChanged = value !== this.original[slider.at];
      row.classList.toggle("changed", isChanged);
      if (isChanged) changes.push(`${slider.name} = ${slider.switch ? Boolean(value) : shownNumber(value)}`);
    }
    element("live-changes").textContent = changes.join("\n");
    element("live-changes").hidden = !changes.length;
  }

  send() {
    this.busy = true;
    this.isWanted = false;
    this.sent = this.parameters.slice();
    this.worker.postMessage({ parameters: this.sent });
  }

  receive(solution) {
    this.busy = false;
    this.panel.solution = { ...solution, parameters: this.sent }; // for tests
    const { isChanged } = this;
    if (isChanged || this.skeleton.solution) this.player.show(this.skeleton, isChanged ? solution : null);
    const { label } = this.skeleton, [name] = this.starts.keys();
    const before = this.distance(null), now = this.distance(solution);
    const apart = now === null ? "" : isChanged
      ? ` Ankles ${now} cm from captured (rms); as ${name} ${before} cm.`
      : ` Ankles ${before} cm from captured (rms).`;
    const words = isChanged
      ? `Live: “${label}” solved by this page in ${Math.round(solution.milliseconds)} ms.`
      : `As ${name}: move a slider.`;
    this.say(words + apart);
    if (this.isWanted) this.send();
  }

  // Root mean square over frames and legs, in cm; null where no captured motion is known.
  distance(solution) {
    const captured = this.player.skeletons.find((skeleton) => skeleton.key === this.live.captured);
    if (!captured) return null;
    const { skeleton } = this, shown = skeleton.solution;
    skeleton.show(solution);
    let sum = 0, count = 0;
    for (let frame = 0; frame < this.player.clip.frames; frame++) {
      skeleton.legs.forEach((joints, leg) => {
        for (const axis of [0, 1, 2]) {
          sum += (skeleton.at(frame, 3 * joints[2] + axis) - captured.at(frame, 3 * captured.legs[leg][2] + axis)) ** 2;
        }
        count++;
      });
    }
    skeleton.show(shown);
    return (100 * Math.sqrt(sum / count)).toFixed(2);
  }

  say(text) {
    element("live-status").hidden = !text;
    element("live-status").textContent = text;
  }
}

if (element("live") && player.stage) player.live = new LivePanel(player, player.clips);
