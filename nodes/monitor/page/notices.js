// What is wrong, as the monitor says; or that the monitor says nothing.

import { ago } from "./dom.js";

const SILENT_S = 0.5;

// All notices as [tone, text]; tone "bad" or "note".
export function notices(model) {
  if (model.over) return [["note", "The graph has ended. What is shown is its last state."]];
  if (model.connection !== "open") {
    const known = model.connection === "closed" || model.connection === "connecting";
    return [["bad", known ? "The monitor cannot be reached; trying again." : model.connection]];
  }
  if (model.silent > SILENT_S) {
    return [["bad", `The monitor has been silent for ${ago(model.silent)}.`]];
  }
  return model.state?.notices ?? [];
}
