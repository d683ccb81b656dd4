// Notices of the monitor; or one that the monitor is silent or unreachable.

import { ago } from "./dom.js";

const SILENT_S = 0.5;

// All notices as [tone, text]; tone "bad" or "note".
export function notices(model) {
  if (model.over) {
    const failed = (model.graph?.nodes ?? []).filter((node) => node.condition === "failed");
    const why = failed.map((node) => `${node.name} failed`).join(", ");
    const last = "The page shows its last state.";
    return [why ? ["bad", `The graph has ended: ${why}. ${last}`]
      : ["note", `The graph has ended. ${last}`]];
  }
  if (model.connection !== "open") {
    const known = model.connection === "closed" || model.connection === "connecting";
    return [["bad", known ? "The monitor cannot be reached; retrying." : model.connection]];
  }
  if (model.silent > SILENT_S) {
    return [["bad", `No data from the monitor for ${ago(model.silent)}.`]];
  }
  return model.state?.notices ?? [];
}
