// Round values for axes.

/** About `count` round values between two, spaced by a multiple of one of `steps`, and their number of digits. */
export function round(low, high, count, steps = [1, 2, 5]) {
  const rough = (high - low) / Math.max(count, 1) || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [...steps, 10 * steps[0]].find((factor) => factor * power >= rough * (1 - 1e-9)) * power;
  const values = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) values.push(i * step);
  return { values, digits: Math.max(0, Math.ceil(-Math.log10(step) - 1e-9)) };
}

/** The same on a logarithmic axis: 1, 2 and 5 of each power of ten, or as few as fit. */
export function roundLog(low, high, count) {
  const [first, last] = [Math.floor(Math.log10(low)), Math.ceil(Math.log10(high))];
  const steps = (last - first) * 3 <= count ? [1, 2, 5] : [1];
  const apart = Math.max(1, Math.ceil((last - first) / Math.max(count, 1)));
  const values = [];
  for (let power = first; power <= last; power += apart) {
    for (const step of steps) values.push(step * 10 ** power);
  }
  return { values: values.filter((value) => value >= low * (1 - 1e-9) && value <= high * (1 + 1e-9)) };
}
