// Stances put right by hand: on the time line by pointer or keys, below it by numbers and buttons.

const GRIP = 7; // px, of each end of a stance, by which it is dragged
const SURE = 0.8; // probability below which a stance is drawn as doubtful

class ContactEditor {
  constructor(player) {
    this.player = player;
    this.svg = element("timeline");
    this.svg.addEventListener("pointerdown", (event) => this.press(event));
    this.svg.addEventListener("pointermove", (event) => this.drag(event));
    for (const end of ["pointerup", "pointercancel"]) this.svg.addEventListener(end, () => this.release());
    this.svg.addEventListener("keydown", (event) => this.key(event));
    this.svg.addEventListener("focusin", (event) => this.select(event.target));
    const act = (id, action) => element(id).addEventListener("click", () => action());
    act("contact-split", () => this.split());
    act("contact-remove", () => this.remove());
    act("contact-undo", () => this.undo());
    act("contact-save", () => this.save());
    element("contact-leave").addEventListener("change", (event) => this.leaveOut(event.target.checked));
    for (const [id, edge] of [["contact-start", "start"], ["contact-end", "end"]]) {
      element(id).addEventListener("change", (event) => this.set(edge, Number(event.target.value)));
    }
  }

  // Takes the stances of the clip that is shown, if they can be changed; returns itself or null.
  setClip() {
    const { clip } = this.player;
    this.contacts = clip.contacts;
    element("contacts").hidden = !this.contacts;
    if (!this.contacts) return null;
    this.legs = structuredClone(this.contacts.legs);
    this.history = [];
    this.selected = null;
    element("contact-add").replaceChildren(...clip.legs.map((name, leg) => {
      const button = make("button", { type: "button" }, name);
      button.addEventListener("click", () => this.add(leg));
      return button;
    }));
    this.refresh();
    return this;
  }

  get stance() {
    return this.selected && this.legs[this.selected.leg][this.selected.index];
  }

  get frame() {
    return 1 / this.player.clip.rate; // s
  }

  seconds(frames) {
    return frames * this.frame;
  }

  // Draws all stances on the time line.
  draw() {
    const { timeline, clip } = this.player, x = (seconds) => timeline.x(seconds * clip.rate);
    this.legs.forEach((stances, leg) => stances.forEach((stance, index) => {
      const kinds = ["contact"];
      if (stance.probability !== null && stance.probability < SURE && !stance.byHand) kinds.push("doubtful");
      if (stance.disagrees) kinds.push("off-ground");
      if (stance.leftOut) kinds.push("left-out");
      const isSelected = this.selected?.leg === leg && this.selected?.index === index;
      if (isSelected) kinds.push("selected");
      const left = x(stance.start), width = Math.max(x(stance.end) - left, 3), top = timeline.top(leg) + 2;
      const group = addSvg(this.svg, "g", {
        class: kinds.join(" "), tabindex: 0, role: "button", "data-leg": leg, "data-index": index,
        "aria-label": `${clip.legs[leg]} ${this.words(stance)}`, "aria-pressed": isSelected,
      });
      addSvg(group, "title", {}, `${clip.legs[leg]} ${this.words(stance)}`);
      addSvg(group, "rect", { class: "bar", x: left, y: top, width, height: TALL_ROW - 5, rx: 3 });
      if (width > 3 * GRIP) {
        for (const edge of [left + 3, left + width - 3]) addSvg(group, "line", { class: "grip", x1: edge, x2: edge, y1: top + 4, y2: top + TALL_ROW - 9 });
      }
      if (stance.disagrees) addSvg(group, "text", { x: left + width / 2, y: top + 12, "text-anchor": "middle" }, "!");
    }));
  }

  words(stance) {
    const parts = [`stands from ${stance.start.toFixed(2)} to ${stance.end.toFixed(2)} s`];
    if (stance.byHand) parts.push("set by hand");
    else if (stance.probability !== null) parts.push(`found with a probability of ${stance.probability.toFixed(2)}`);
    if (stance.gap !== null) {
      const where = `${Math.abs(stance.gap).toFixed(1)} cm ${stance.gap < 0 ? "in" : "over"} the ground`;
      parts.push(stance.disagrees ? `its sole does not agree with the ground: ${where}` : `sole ${where}`);
    }
    if (stance.leftOut) parts.push("left out of the fit");
    return parts.join("; ");
  }

  refresh() {
    const { stance } = this, unit = this.frame.toFixed(4);
    for (const id of ["contact-start", "contact-end", "contact-split", "contact-remove", "contact-leave"]) element(id).disabled = !stance;
    element("contact-words").textContent = stance
      ? `${this.player.clip.legs[this.selected.leg]} ${this.words(stance)}.`
      : "Click a stance on the time line; drag its ends or all of it.";
    element("contact-start").value = stance ? stance.start.toFixed(3) : "";
    element("contact-end").value = stance ? stance.end.toFixed(3) : "";
    for (const id of ["contact-start", "contact-end"]) element(id).step = unit;
    element("contact-leave").checked = Boolean(stance?.leftOut);
    element("contact-undo").disabled = !this.history.length;
    element("contact-save").disabled = !this.history.length;
    const { timeline } = this.player;
    if (timeline.contacts) {
      timeline.drawAll();
      timeline.point(this.player.time);
    }
  }

  focus() {
    const { leg, index } = this.selected ?? {};
    this.svg.querySelector(`[data-leg="${leg}"][data-index="${index}"]`)?.focus();
  }

  select(target) {
    const group = target.closest(".contact");
    if (!group) return;
    const leg = Number(group.dataset.leg), index = Number(group.dataset.index);
    if (this.selected?.leg === leg && this.selected?.index === index) return;
    this.selected = { leg, index };
    this.refresh();
    this.focus();
  }

  remember() {
    this.history.push(structuredClone(this.legs));
  }

  undo() {
    this.legs = this.history.pop();
    this.selected = null;
    this.refresh();
  }

  // How far the selected stance may reach: up to its neighbours and the ends of the clip.
  get limits() {
    const { leg, index } = this.selected, stances = this.legs[leg], last = this.seconds(this.player.clip.frames - 1);
    return [stances[index - 1] ? stances[index - 1].end + this.frame : 0, stances[index + 1] ? stances[index + 1].start - this.frame : last];
  }

  // Moves the ends of the selected stance, on whole frames, as far as there is room.
  place(start, end) {
    const [low, high] = this.limits, { stance } = this;
    const whole = (seconds) => Math.round(seconds / this.frame) * this.frame;
    stance.start = Math.min(Math.max(whole(start), low), end - this.frame);
    stance.end = Math.max(Math.min(whole(end), high), stance.start + this.frame);
    Object.assign(stance, { byHand: true, gap: null, disagrees: false });
    this.refresh();
  }

  set(edge, seconds) {
    if (!this.stance || !Number.isFinite(seconds)) return;
    this.remember();
    const { start, end } = { ...this.stance, [edge]: seconds };
    this.place(start, end);
  }

  press(event) {
    const group = event.target.closest(".contact");
    if (!group) return;
    this.select(group);
    event.preventDefault();
    this.svg.setPointerCapture(event.pointerId);
    const { timeline, clip } = this.player, { start, end } = this.stance;
    const near = (seconds) => Math.abs(timeline.x(seconds * clip.rate) + this.svg.getBoundingClientRect().left - event.clientX) < GRIP;
    this.dragged = { edge: near(end) ? "end" : near(start) ? "start" : "both", from: timeline.time(event.clientX), start, end, isBegun: false };
  }

  drag(event) {
    if (!this.dragged) return;
    const { timeline } = this.player, { edge, from, start, end } = this.dragged;
    const moved = this.seconds(timeline.time(event.clientX) - from);
    if (!this.dragged.isBegun) {
      if (Math.abs(moved) < this.frame / 2) return;
      this.remember();
      this.dragged.isBegun = true;
    }
    const [low, high] = this.limits;
    if (edge === "start") this.place(start + moved, end);
    else if (edge === "end") this.place(start, end + moved);
    else {
      const shift = Math.min(Math.max(moved, low - start), high - end);
      this.place(start + shift, end + shift);
    }
  }

  release() {
    if (this.dragged) this.focus();
    this.dragged = null;
  }

  key(event) {
    if (!this.stance || event.ctrlKey || event.metaKey || event.altKey) return;
    const step = { ArrowLeft: -this.frame, ArrowRight: this.frame }[event.key];
    const { start, end } = this.stance;
    if (step) {
      this.remember();
      if (event.shiftKey) this.place(start + step, end);
      else this.place(start, end + step);
    } else if (event.key === "Delete" || event.key === "Backspace") this.remove();
    else if (event.key === "s") this.split();
    else if (event.key === "x") this.leaveOut(!this.stance.leftOut);
    else return;
    event.preventDefault();
    this.focus();
  }

  // In two at the cursor, or else in the middle, with a swing of two frames between.
  split() {
    const { leg, index } = this.selected, { stance } = this, now = this.seconds(Math.round(this.player.time));
    const isInside = now > stance.start + this.frame && now < stance.end - this.frame;
    const at = isInside ? now : this.seconds(Math.round((stance.start + stance.end) / 2 / this.frame));
    if (!(at - this.frame > stance.start && at + this.frame < stance.end)) return;
    this.remember();
    const half = { ...stance, byHand: true, gap: null, disagrees: false };
    this.legs[leg].splice(index, 1, { ...half, end: at - this.frame }, { ...half, start: at + this.frame });
    this.refresh();
  }

  remove() {
    this.remember();
    this.legs[this.selected.leg].splice(this.selected.index, 1);
    this.selected = null;
    this.refresh();
  }

  leaveOut(leftOut) {
    this.remember();
    this.stance.leftOut = leftOut;
    this.refresh();
  }

  // A stance of a leg from the cursor on, as long as there is room up to 0.4 s.
  add(leg) {
    const { clip, time } = this.player, stances = this.legs[leg];
    const start = this.seconds(Math.round(time)), last = this.seconds(clip.frames - 1);
    const next = stances.findIndex((stance) => stance.start > start), index = next < 0 ? stances.length : next;
    const end = Math.min(start + 0.4, stances[index] ? stances[index].start - this.frame : last);
    const before = stances[index - 1];
    if (end <= start || (before && before.end >= start)) {
      element("contact-words").textContent = `${clip.legs[leg]} stands there already, or the clip ends.`;
      return;
    }
    this.remember();
    stances.splice(index, 0, { start, end, probability: null, byHand: true, leftOut: false, gap: null, disagrees: false });
    this.selected = { leg, index };
    this.refresh();
    this.focus();
  }

  async save() {
    const words = element("contact-words"), { index } = this.player;
    words.textContent = "Saving and reading the clip again ...";
    try {
      const answer = await this.player.program.saveContacts(index, this.legs);
      this.player.replaceClip(index, answer.clip);
      words.textContent = answer.message;
    } catch (error) {
      words.textContent = error.message;
    }
  }
}
