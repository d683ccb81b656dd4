// What is wrong, or out of the ordinary, in words.

import { ago } from "./dom.js";

const RECENT_MS = 4000;
const GRAPH_AGE_S = 2.5;

export class Notices {
  constructor() {
    this.counts = new Map(); // name -> [count, time of its last rise]
  }

  // Whether a count has risen within the last seconds; and by how much since it began to.
  risen(name, count, now) {
    const before = this.counts.get(name);
    if (!before || count < before.count) {
      this.counts.set(name, { count, since: count, at: -Infinity });
      return 0;
    }
    if (count > before.count) {
      if (now - before.at > RECENT_MS) before.since = before.count;
      before.count = count;
      before.at = now;
    }
    return now - before.at < RECENT_MS ? before.count - before.since : 0;
  }

  // All notices as [tone, text]; tone "bad" or "note".
  list(model, now) {
    const found = [];
    if (model.connection !== "open") {
      if (model.over) return [["note", "The graph has ended. What is shown is its last state."]];
      const why = model.connection === "closed" || model.connection === "connecting"
        ? "The monitor cannot be reached; trying again." : model.connection;
      return [["bad", why]];
    }
    if (model.silent > 0.5) {
      return [["bad", `The monitor has been silent for ${ago(model.silent)}.`]];
    }
    const { state } = model;
    if (!state) return found;
    if (model.graph && state.graph_age_s > GRAPH_AGE_S) {
      found.push(["bad", `No news of the nodes for ${ago(state.graph_age_s)}.`]);
    }
    for (const node of model.graph?.nodes ?? []) found.push(...this.ofNode(node, now));
    for (const [name, patch] of Object.entries(state.patches)) {
      found.push(...this.ofPatch(name, patch, model, now));
    }
    return found;
  }

  ofNode(node, now) {
    const found = [];
    const restarts = this.risen(`restarts ${node.name}`, node.restarts, now);
    if (["failed", "not answering", "restarting", "starting"].includes(node.condition)) {
      found.push(["bad", `${node.name}: ${node.condition}.`]);
    } else if (restarts) {
      found.push(["note", `${node.name} was started again.`]);
    }
    if (this.risen(`refused ${node.name}`, node.refused, now) && node.refusal) {
      found.push(["bad", `${node.name} refuses messages: ${node.refusal}`]);
    }
    if (node.condition === "paused") found.push(["note", `${node.name} is paused.`]);
    return found;
  }

  ofPatch(name, patch, model, now) {
    const found = [];
    const many = Object.keys(model.state.patches).length > 1 ? `${name}: ` : "";
    if (patch.ended) {
      found.push(["note", `${many}the stream has ended.`]);
    } else if (!model.quiet && !Object.keys(patch.age_s).length) {
      found.push(["note", `${many}no frame has come yet.`]);
    } else if (!model.quiet) {
      const restored = patch.age_s.restored ?? Infinity, taxels = patch.age_s.taxels ?? Infinity;
      const newest = Math.min(restored, taxels);
      if (newest > patch.stale_s) {
        found.push(["bad", `${many}stale: no new frame for ${ago(newest)}.`]);
      } else if (restored > patch.stale_s) {
        found.push(["bad", restored === Infinity ? `${many}frames are sensed, none is restored.`
          : `${many}stale: frames are sensed, none restored for ${ago(restored)}.`]);
      }
    }
    const lost = this.risen(`lost ${name}`, patch.summary?.frames?.lost_so_far ?? 0, now);
    if (lost) found.push(["bad", `${many}${lost} frames lost just now.`]);
    return found;
  }
}
