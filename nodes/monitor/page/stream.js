// Reads the monitor's stream: records of a JSON header and its arrays; connects again when it ends.

const TYPES = { "<i4": Int32Array, "<f4": Float32Array, "<f8": Float64Array, "|u1": Uint8Array, "|i1": Int8Array };
const RETRY_MS = 1000;

function parsed(bytes, offset, nHead) {
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(offset, offset + nHead)));
  let start = offset + nHead;
  header.data = {};
  for (const [name, dtype, shape] of header.arrays) {
    const n = shape.reduce((a, b) => a * b, 1);
    const end = start + n * TYPES[dtype].BYTES_PER_ELEMENT;
    // A copy, because a typed array must begin at a multiple of its element size.
    header.data[name] = new TYPES[dtype](bytes.slice(start, end).buffer);
    start = end;
  }
  return header;
}

class Records {
  #bytes = new Uint8Array(0);

  // Complete records, once these bytes are appended to the incomplete rest.
  *add(chunk) {
    const bytes = new Uint8Array(this.#bytes.length + chunk.length);
    bytes.set(this.#bytes);
    bytes.set(chunk, this.#bytes.length);
    const view = new DataView(bytes.buffer);
    let at = 0;
    while (bytes.length - at >= 8) {
      const nHead = view.getUint32(at, true), nData = view.getUint32(at + 4, true);
      if (bytes.length - at < 8 + nHead + nData) break;
      yield parsed(bytes, at + 8, nHead);
      at += 8 + nHead + nData;
    }
    this.#bytes = bytes.slice(at);
  }
}

export class Stream {
  // onRecord takes a record; onConnection takes "connecting", "open" or the reason of a failure.
  constructor(patch, onRecord, onConnection) {
    this.aborter = new AbortController();
    this.run(patch, onRecord, onConnection);
  }

  close() {
    this.aborter.abort();
  }

  async run(patch, onRecord, onConnection) {
    const query = patch === null ? "" : `?patch=${encodeURIComponent(patch)}`;
    const { signal } = this.aborter;
    while (!signal.aborted) {
      onConnection("connecting");
      let why = "";
      try {
        const answer = await fetch(`stream${query}`, { signal, cache: "no-store" });
        if (answer.ok) {
          onConnection("open");
          const records = new Records();
          const reader = answer.body.getReader();
          for (let part = await reader.read(); !part.done; part = await reader.read()) {
            for (const record of records.add(part.value)) onRecord(record);
          }
        } else {
          why = (await answer.text()).trim();
          if (answer.status === 404) location.hash = "#/"; // no such patch: show the overview
        }
      } catch (error) {
        why = "";
        // A connection that fails is a TypeError; anything else is a fault of the page.
        if (!signal.aborted && !(error instanceof TypeError)) console.error(error);
      }
      if (signal.aborted) return;
      onConnection(why || "closed");
      await new Promise((done) => setTimeout(done, RETRY_MS));
    }
  }
}
