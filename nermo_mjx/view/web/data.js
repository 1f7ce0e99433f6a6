// Reads the arrays that nermo_mjx/view/clip.py wrote into the page.

const MISSING = -32768;

/** The page's parts of data by their names, unpacked. */
export async function unpackAll() {
  const elements = [...document.querySelectorAll("[data-part]")];
  return Object.fromEntries(await Promise.all(elements.map(async (each) => [each.dataset.part, await unpack(each.textContent)])));
}

/** The bytes of one part. */
export async function unpack(text) {
  const bytes = Uint8Array.from(atob(text.trim()), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

const PLAIN = { float32: Float32Array, uint32: Uint32Array, uint16: Uint16Array };

/** What an entry of the header stands for, from `{part: buffer}`: an array row by row, with NaN where values are missing. */
export function read(parts, entry) {
  const buffer = parts[entry.part];
  const size = entry.shape.reduce((product, n) => product * n, 1);
  if (PLAIN[entry.kind]) return new PLAIN[entry.kind](buffer, entry.at, size);
  if (entry.kind === "json") return JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, entry.at, size)));
  return readSteps(new Uint8Array(buffer, entry.at, 2 * size), size, entry);
}

function readSteps(bytes, size, entry) {
  const rows = entry.shape[0];
  const columns = rows ? size / rows : 0;
  const values = new Float32Array(size);
  for (let column = 0, i = 0; column < columns; column++) {
    let step = 0;
    for (let row = 0; row < rows; row++, i++) {
      step = ((step + ((bytes[i] << 8) | bytes[size + i])) << 16) >> 16;
      values[row * columns + column] = step === MISSING ? NaN : entry.zero + entry.scale * step;
    }
  }
  return values;
}
