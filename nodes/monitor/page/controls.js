// Controls of a patch's nodes. A request goes to the node that owns the setting; the page shows its
// answer: done, or the reason of the refusal.

import { byId, element, fixed, setText } from "./dom.js";

// The settings shown, in this order: [node type, setting, label].
const SETTINGS = [
  ["reconstructor", "preset", "Preset"],
  ["reconstructor", "solver", "Solver"],
  ["reconstructor", "basis", "Basis"],
  ["reconstructor", "iterations", "Iterations"],
  ["reconstructor", "lambda_n", "λ (for a range of 2.5)"],
  ["reconstructor", "budget_ms", "Time budget (ms/frame)"],
  ["reconstructor", "contact_force", "Least force of a contact"],
  ["reconstructor", "contact_over", "Force of the event ◆ over"],
  ["reconstructor", "contact_slide", "Speed of the event ▶ slide"],
  ["compressor", "m", "Measurements M"],
  ["compressor", "rows", "Rows of Φ"],
  ["compressor", "bits", "Bits per measurement"],
  ["sensor", "noise", "Noise (× paper)"],
  ["sensor", "rate_hz", "Rate (Hz; 0 pauses)"],
];
const SHOWN_MS = { done: 6000, refused: 20000 }; // an answer, which then fades
const PATIENCE_MS = 30000; // the launcher answers after 20 s in place of a node

export class Controls {
  constructor(root) {
    this.root = root;
    this.waiting = new Map(); // id of a request -> {line, timer}
    this.shape = "";
    this.why = element("strong", {});
  }

  // Let all controls rest, and say why; "": they are in use.
  rest(why) {
    this.root.disabled = why !== "";
    setText(this.why, why);
  }

  // Show the state of the graph; rebuild the controls if its nodes differ.
  show(graph, patch, hasContacts, hasTruth) {
    const serves = (node) => node.patch === patch || (node.patch && node.patches.includes(patch));
    const nodes = graph.nodes.filter((node) => serves(node) || "seek" in node.commands);
    const shape = JSON.stringify([patch, hasContacts, hasTruth,
      nodes.map((node) => [node.name, node.type, "tare_left" in node.state])]);
    if (shape !== this.shape) {
      this.shape = shape;
      this.build(nodes, hasContacts, hasTruth);
    }
    for (const node of nodes) this.refresh(node);
    const recording = byId("record");
    if (recording) {
      recording.dataset.value = JSON.stringify(!graph.recording);
      setText(recording, graph.recording ? "■ Stop recording" : "● Record");
    }
  }

  build(nodes, hasContacts, hasTruth) {
    this.root.replaceChildren(element("h2", {}, "Controls"), this.why);
    const player = nodes.find((node) => "seek" in node.commands);
    if (player) this.root.append(this.playerControls(player.name));
    const sources = nodes.filter((node) => "pause" in node.commands && node !== player);
    const buttons = element("div", { class: "buttons" });
    for (const node of sources) {
      buttons.append(this.button(node.name, "pause", "", { "data-pause": node.name }));
      if ("tare_left" in node.state) {
        buttons.append(this.button(node.name, "tare", "Tare", { "data-tare": node.name,
          title: "take the readings of the untouched skin for zero" }));
      }
    }
    buttons.append(this.button("launch", "record", "● Record", { id: "record" }));
    this.root.append(buttons, this.answerLine("launch"));
    for (const [type, key, label] of SETTINGS) {
      for (const node of nodes.filter((found) => found.type.replace(/_batch$/, "") === type)) {
        const entry = node.controls.find((found) => found.key === key);
        if (!entry || (key.startsWith("contact_") && !hasContacts)) continue;
        if (key === "noise" && !hasTruth) continue; // of readings, the noise is their own
        this.root.append(this.field(node.name, entry, label));
      }
    }
  }

  answerLine(name) {
    return element("output", { "data-answer": name, "aria-live": "polite" });
  }

  button(node, command, label, attributes = {}, line = "launch") {
    return element("button", { type: "button", ...attributes, onclick: (event) => {
      const { value } = event.currentTarget.dataset;
      this.ask(node, command, value === undefined ? null : JSON.parse(value), line);
    } }, label);
  }

  playerControls(name) {
    const seek = element("input", { type: "range", min: 0, step: "any", "data-seek": name,
      "aria-label": "position in the recording",
      onchange: (event) => this.ask(name, "seek", Number(event.target.value), name) });
    const rate = element("input", { type: "number", min: 0, max: 1000, step: "any",
      "data-rate": name, "aria-label": "rate of the replay" });
    const form = element("form", { class: "line", novalidate: true, onsubmit: (event) => {
      event.preventDefault();
      this.setRate(name, "rate", Number(rate.value), name);
    } }, element("label", {}, "Replay rate × (0 pauses)", rate), element("button", {}, "Set"));
    return element("div", { class: "player" },
      element("div", { class: "buttons" },
        this.button(name, "pause", "", { "data-pause": name }, name),
        this.button(name, "step", "Step", {}, name),
        this.button(name, "slower", "Slower", {}, name),
        this.button(name, "faster", "Faster", {}, name)),
      seek, element("span", { "data-position": name }), form, this.answerLine(name));
  }

  field(node, entry, label) {
    const options = entry.choices.length ? entry.choices : entry.known;
    const id = `${node}.${entry.key}`;
    const input = options.length
      ? element("select", { id }, element("option", { value: "", hidden: true }, "–"),
        ...options.map((name) => element("option", {}, name)))
      : element("input", { id, type: "number", placeholder: "default", step: entry.type.startsWith("int") ? 1 : "any",
        ...(entry.low === null ? {} : { min: entry.low }),
        ...(entry.high === null ? {} : { max: entry.high }) });
    const send = (event) => {
      event.preventDefault();
      if (input.validity.badInput) {
        this.say(id, "refused", "✗ not a number");
        return;
      }
      const value = options.length ? input.value : input.value === "" ? null : Number(input.value);
      if (entry.key === "rate_hz") this.setRate(node, "set", value, id);
      else this.ask(node, "set", { [entry.key]: value }, id);
    };
    // A choice is sent at once; a number by Enter or the button.
    if (options.length) input.addEventListener("change", send);
    return element("form", { class: "line", title: entry.doc, onsubmit: send, novalidate: true },
      element("label", {}, label, input),
      ...(options.length ? [] : [element("button", {}, "Set")]), this.answerLine(id));
  }

  // Show the current values, but not over a field that is being edited.
  refresh(node) {
    for (const entry of node.controls) {
      const input = byId(`${node.name}.${entry.key}`);
      if (!input || document.activeElement === input) continue;
      const value = node.state[entry.key] ?? node.settings[entry.key] ?? "";
      const text = typeof value === "number" ? String(+value.toPrecision(6)) : String(value);
      if (input.dataset.shown !== text) {
        input.dataset.shown = text;
        input.value = text;
      }
    }
    for (const button of this.root.querySelectorAll(`[data-pause="${node.name}"]`)) {
      button.dataset.value = JSON.stringify(!node.state.paused);
      setText(button, node.state.paused ? `▶ Resume` : `❚❚ Pause`);
    }
    const tare = this.root.querySelector(`[data-tare="${node.name}"]`);
    if (tare) {
      const { tare_left: left, tared = "" } = node.state;
      tare.dataset.tared ??= tared; // of a tare before this page
      tare.disabled = left > 0;
      setText(tare, left > 0 ? `Tare: ${left} frames` : "Tare");
      // The answer said that it began; this is how it ended. A short one is never seen running.
      if (left > 0) tare.dataset.running = "true";
      else if (tared && (tare.dataset.running || tared !== tare.dataset.tared)) {
        delete tare.dataset.running;
        tare.dataset.tared = tared;
        this.say("launch", "done", `✓ tared: ${tared}`);
      }
    }
    const seek = this.root.querySelector(`[data-seek="${node.name}"]`);
    if (seek) this.refreshPlayer(node, seek);
  }

  refreshPlayer({ name, state }, seek) {
    if (document.activeElement !== seek || !seek.matches(":active")) {
      seek.max = state.length_s ?? 0;
      seek.value = state.position_s ?? 0;
    }
    setText(this.root.querySelector(`[data-position="${name}"]`),
      `${fixed(state.position_s, 1)} of ${fixed(state.length_s, 1, "s")}`);
    const rate = this.root.querySelector(`[data-rate="${name}"]`);
    if (document.activeElement !== rate) rate.value = fixed(state.rate, 3);
  }

  // A rate of 0 pauses; another one resumes what is paused.
  async setRate(node, command, rate, line) {
    if (rate === 0) return this.ask(node, "pause", true, line);
    if (this.root.querySelector(`[data-pause="${node}"][data-value="false"]`)) {
      await this.ask(node, "pause", false, line);
    }
    return this.ask(node, command, command === "set" ? { rate_hz: rate } : rate, line);
  }

  async ask(node, command, value, line) {
    const id = Array.from(crypto.getRandomValues(new Uint32Array(3)), (n) => n.toString(16)).join("");
    const timer = setTimeout(() => this.answer({ id, done: false, text: `no answer within ${PATIENCE_MS / 1000} s` }),
      PATIENCE_MS);
    this.waiting.set(id, { line, timer });
    this.say(line, "asking", "…");
    try {
      const answer = await fetch("request", {
        method: "POST", headers: { "Content-Type": "application/json" },
        body: JSON.stringify({ id, node, command, value }),
      });
      if (!answer.ok) this.answer({ id, done: false, text: (await answer.text()).trim() });
    } catch (error) {
      this.answer({ id, done: false, text: "the monitor does not answer" });
    }
  }

  answer({ id, done, text }) {
    const waiting = this.waiting.get(id);
    if (!waiting) return; // of another page
    this.waiting.delete(id);
    clearTimeout(waiting.timer);
    const input = byId(waiting.line);
    if (input) delete input.dataset.shown; // the current value is shown again, also after a refusal
    this.say(waiting.line, done ? "done" : "refused", done ? `✓ ${text}` : `✗ ${text}`);
  }

  say(line, state, text) {
    const output = this.root.querySelector(`[data-answer="${CSS.escape(line)}"]`);
    if (!output) return;
    output.dataset.state = state;
    setText(output, text);
    clearTimeout(output.fading);
    delete output.dataset.old;
    output.fading = SHOWN_MS[state] && setTimeout(() => (output.dataset.old = ""), SHOWN_MS[state]);
  }
}
