// Runs grouped in cells of two axes, each cell with the value of one of its runs, or with their mean.

/**
 * The cells that some runs fill. `of` is `best`, `mean` or `worst`; each has its bins, its runs from the best to the
 * worst, a value, and the run that stands for it.
 */
export function cellsOf(across, up, colour, places, of) {
  const found = new Map();
  for (const place of places) {
    const [x, y] = [across.bin(place), up.bin(place)];
    if (x < 0 || y < 0) continue;
    const key = y * across.bins + x;
    if (!found.has(key)) found.set(key, { x, y, places: [] });
    found.get(key).places.push(place);
  }
  for (const cell of found.values()) {
    const costs = new Map(cell.places.map((place) => [place, colour.isText ? 0 : colour.cost(colour.values[place])]));
    cell.places.sort((a, b) => costs.get(a) - costs.get(b) || a - b);
    Object.assign(cell, colour.isText ? commonest(colour, cell.places) : valued(colour, cell.places, of));
  }
  return [...found.values()];
}

function commonest(colour, places) {
  const counts = new Map();
  for (const place of places) counts.set(colour.values[place], (counts.get(colour.values[place]) ?? 0) + 1);
  const [value] = [...counts].reduce((most, each) => (each[1] > most[1] ? each : most));
  return { value, place: places.find((place) => colour.values[place] === value) };
}

function valued(colour, places, of) {
  const good = places.filter((place) => Number.isFinite(colour.values[place]));
  if (!good.length) return { value: NaN, place: places[0] };
  if (of !== "mean") {
    const place = of === "best" ? good[0] : good.at(-1);
    return { value: colour.values[place], place };
  }
  const value = good.reduce((sum, place) => sum + colour.values[place], 0) / good.length;
  const off = (place) => Math.abs(colour.values[place] - value);
  return { value, place: good.reduce((best, place) => (off(place) < off(best) ? place : best)) };
}
