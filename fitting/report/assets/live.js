// Sliders of parameters: the clip is solved again, and its motion is drawn instead.

const PAUSE = 1000; // ms, after which moving the same slider is a new step

const shownNumber = (value) => (Number.isFinite(value) ? String(Number(value.toPrecision(4))) : value > 0 ? "∞" : "-∞");

class LivePanel {
  constructor(player) {
    this.player = player;
    this.scripts = Object.assign({}, ...player.clips.map((clip) => clip?.live?.scripts));
    this.panel = element("live");
    this.panel.addEventListener("toggle", () => this.panel.open && this.open());
    element("live-system").addEventListener("change", (event) => this.player.watch(event.target.value));
    element("live-undo").addEventListener("click", () => this.step(this.done, this.undone));
    element("live-redo").addEventListener("click", () => this.step(this.undone, this.done));
    element("live-save")?.addEventListener("click", () => this.save());
    document.addEventListener("keydown", (event) => this.key(event));
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
    this.solver?.terminate();
    this.solver = this.system = null;
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

  // Makes the sliders of a system and what solves it.
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
      this.costs = new Map();
      this.own = starts[0]; // with which the page was made
      this.restart(starts[0].slice());
      const solver = await this.makeSolver(system);
      if (this.system !== system) return solver.terminate();
      this.solver = solver;
      this.busy = false;
      this.send();
    } catch (error) {
      this.say(`This browser cannot solve the motion: ${error.message}`);
    }
  }

  async makeSolver(system) {
    const { live, player } = this, { program } = player;
    const solver = program
      ? program.solver(player.index)
      : await workerSolver(live, this.scripts[system.script], system.trunk, player.skeletons[0], player.clip.frames);
    const ifCurrent = (act) => (event) => solver === this.solver && act(event); // an ended one may still say something
    solver.onmessage = ifCurrent((event) => this.receive(event.data));
    solver.onerror = ifCurrent((event) => {
      this.busy = false;
      this.say(program ? event.message : `This browser cannot solve the motion: ${event.message}`);
      if (this.isWanted) this.send();
    });
    return solver;
  }

  // Begins with these values, without a way back to earlier ones.
  restart(parameters) {
    this.parameters = parameters;
    this.done = [];
    this.undone = [];
    this.last = { name: null, time: 0 };
    this.makeControls();
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
    this.makeStarts();
    this.refresh();
  }

  makeStarts() {
    element("live-starts").replaceChildren(...[...this.starts].map(([name, values]) => {
      const button = make("button", { type: "button" }, name);
      button.addEventListener("click", () => {
        this.remember(null);
        this.parameters.set(values);
        this.update();
      });
      return button;
    }));
  }

  makeControl(slider) {
    const id = `live-${this.controls.length}`;
    const input = slider.switch
      ? make("input", { id, type: "checkbox", autocomplete: "off" })
      : make("input", { id, type: "range", autocomplete: "off", min: slider.low, max: slider.high, step: slider.step });
    const output = make("output", { htmlFor: id });
    input.addEventListener("input", () => {
      this.remember(slider.name);
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

  // Keeps the values as they are; moves of one slider without a pause are one step.
  remember(name) {
    const now = performance.now();
    if (name === null || name !== this.last.name || now - this.last.time > PAUSE) this.done.push(this.parameters.slice());
    this.undone = [];
    this.last = { name, time: now };
  }

  step(source, target) {
    if (!source?.length) return;
    target.push(this.parameters.slice());
    this.parameters.set(source.pop());
    this.last = { name: null, time: 0 };
    this.update();
  }

  key(event) {
    if (!this.system || !(event.ctrlKey || event.metaKey) || event.target.matches("input[type=number], input[type=text]")) return;
    const isRedo = event.key === "y" || (event.key.toLowerCase() === "z" && event.shiftKey);
    if (!isRedo && event.key !== "z") return;
    event.preventDefault();
    if (isRedo) this.step(this.undone, this.done);
    else this.step(this.done, this.undone);
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
      if (this.solver && !this.busy) this.send();
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
    element("live-undo").disabled = !this.done.length;
    element("live-redo").disabled = !this.undone.length;
  }

  send() {
    this.busy = true;
    this.isWanted = false;
    this.sent = this.parameters.slice();
    this.solver.postMessage({ parameters: this.sent, layers: this.player.layers });
  }

  receive(solution) {
    this.busy = false;
    this.panel.solution = { ...solution, parameters: this.sent }; // for tests
    const { isChanged } = this;
    const isOwn = this.sent.every((value, i) => value === this.own[i]);
    if (!isOwn || this.skeleton.solution || this.player.program) {
      this.player.show(this.skeleton, isOwn ? null : solution, solution);
    }
    const { label } = this.skeleton, [name] = this.starts.keys();
    const words = isChanged ? `Live: “${label}” solved in ${Math.round(solution.milliseconds)} ms.` : `As ${name}: move a slider.`;
    this.say([words, this.distanceText(solution, name), this.costText(solution)].filter(Boolean).join(" "));
    if (this.isWanted) this.send();
  }

  distanceText(solution, name) {
    const { measuring } = this.player, { skeleton } = this;
    if (!measuring.captured) return "";
    const shown = skeleton.solution;
    const [before, now] = [null, solution].map((motion) => {
      skeleton.show(motion);
      return measuring.row(skeleton)[0].toFixed(2);
    });
    skeleton.show(shown);
    return this.isChanged
      ? `Ankles ${now} cm from captured (rms); as ${name} ${before} cm.`
      : `Ankles ${before} cm from captured (rms).`;
  }

  // What a fit minimises, beside that of the systems to go back to.
  costText({ cost }) {
    if (cost === undefined || cost === null) return "";
    for (const [name, values] of this.starts) {
      if (values.every((value, i) => value === this.sent[i])) this.costs.set(name, cost);
    }
    const others = [...this.costs].map(([name, value]) => `${name} ${Number(value.toPrecision(6))}`).join(", ");
    return `Cost ${Number(cost.toPrecision(6))}${others ? ` (${others})` : ""}.`;
  }

  async save() {
    const words = element("live-saved");
    try {
      const messages = await this.player.program.save(this.parameters, element("live-drop").checked);
      words.replaceChildren(...messages.map((message) => make("li", {}, message)));
    } catch (error) {
      words.replaceChildren(make("li", {}, error.message));
    }
  }

  // Another system to go back to, with which the sliders begin: as a fit that goes on finds better ones.
  async replace(name, packed, note) {
    if (!this.system) return;
    const values = await doubles(packed);
    this.starts = new Map([[name, values], ...[...this.starts].filter(([other]) => other !== name)]);
    this.restart(values.slice());
    element("live-saved").replaceChildren(make("li", {}, note));
    this.update();
  }

  say(text) {
    element("live-status").hidden = !text;
    element("live-status").textContent = text;
  }
}
