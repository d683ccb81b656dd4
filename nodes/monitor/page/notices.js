// What is wrong, as the monitor says; or that the monitor says nothing.

import { ago } from "./dom.js";

const SILENT_S = 0.5;

// All notices as [tone, text]; tone "bad" or "note".
export function notices(model) {
  if (model.over) {
    const failed = (model.graph?.nodes ?? []).filter((node) => node.condition === "failed");
    const why = failed.map((node) => `${node.name} failed`).join(", ");
    const last = "What is shown is its last state.";
    return [why ? ["bad", `The graph has ended: ${why}. ${last}`]
      : ["note", `The graph has ended. ${last}`]];
  }
  if (model.connection !== "open") {
    const known = model.connection === "closed" || model.connection === "connecting";
    return [["bad", known ? "The monitor cannot be reached; trying again." : model.connection]];
  }
  if (model.silent > SILENT_S) {
    return [["bad", `The monitor has been silent for ${ago(model.silent)}.`]];
  }
  return model.state?.notices ?? [];
}
