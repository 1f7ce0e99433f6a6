// Reads the arrays that nermo_mjx/view/packing.py wrote into the page.

const MISSING = -32768;

/** The unpacked bytes of the page's data element. */
export async function unpack(text) {
  const bytes = Uint8Array.from(atob(text.trim()), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

/** One array of the header, as a typed array row by row; missing values are NaN. */
export function read(buffer, entry) {
  const size = entry.shape.reduce((product, n) => product * n, 1);
  if (entry.kind === "float32") return new Float32Array(buffer, entry.at, size);
  if (entry.kind === "uint32") return new Uint32Array(buffer, entry.at, size);
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
