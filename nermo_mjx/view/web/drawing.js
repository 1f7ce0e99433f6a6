// Drawing on canvases: at the screen's resolution, scales and round ticks, lines, points, rings, shortened names.

/**
 * A canvas of so many of the page's pixels, ready to draw on. The processor draws: copying ten thousand points on emulated
 * graphics takes half a second.
 */
export function sheet(canvas, width, height) {
  const ratio = Math.min(devicePixelRatio, 2);
  Object.assign(canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
  const paper = canvas.getContext("2d", { willReadFrequently: true });
  paper.setTransform(ratio, 0, 0, ratio, 0, 0);
  return paper;
}

export function line(paper, x1, y1, x2, y2) {
  paper.beginPath();
  paper.moveTo(x1, y1);
  paper.lineTo(x2, y2);
  paper.stroke();
}

/** The picture of a point and its size: a disc with an edge, or a cross where a run did not go well. */
export function sprite(colour, ink, radius, bad) {
  const size = Math.ceil(2 * radius + 4);
  const canvas = document.createElement("canvas");
  const paper = sheet(canvas, size, size);
  const middle = size / 2;
  if (bad) {
    const r = 0.75 * radius;
    paper.lineCap = "round";
    for (const [stroke, width] of [[ink, 3.2], [colour, 1.8]]) {
      Object.assign(paper, { strokeStyle: stroke, lineWidth: width });
      paper.stroke(new Path2D(`M${middle - r} ${middle - r}l${2 * r} ${2 * r}m0 ${-2 * r}l${-2 * r} ${2 * r}`));
    }
    return { canvas, size };
  }
  paper.fillStyle = colour;
  paper.beginPath();
  paper.arc(middle, middle, radius, 0, 2 * Math.PI);
  paper.fill();
  // So that both ends of the scale stand out from the background.
  paper.globalAlpha = 0.5;
  Object.assign(paper, { strokeStyle: ink, lineWidth: 0.7 });
  paper.stroke();
  return { canvas, size };
}

export function ring(paper, x, y, radius) {
  paper.beginPath();
  paper.arc(x, y, radius, 0, 2 * Math.PI);
  paper.stroke();
}

/** A text, shortened to fit. */
export function clipped(paper, text, width) {
  if (paper.measureText(text).width <= width) return text;
  let length = text.length;
  while (length > 1 && paper.measureText(`${text.slice(0, length)}…`).width > width) length--;
  return `${text.slice(0, length)}…`;
}

/** The least and the greatest of some values, by default of all; NaN is passed over. */
export function extent(values, places = values.keys()) {
  let [low, high] = [Infinity, -Infinity];
  for (const place of places) {
    if (values[place] < low) low = values[place];
    if (values[place] > high) high = values[place];
  }
  return [low, high];
}

/** Values from one to another, evenly or by their logarithms, as shares of the way. */
export class Scale {
  constructor(low, high, log) {
    [this.from, this.to] = log ? [Math.log(low), Math.log(high)] : [low, high];
    this.log = log;
  }

  share(value) {
    return ((this.log ? Math.log(value) : value) - this.from) / (this.to - this.from);
  }

  value(share) {
    const scaled = this.from + share * (this.to - this.from);
    return this.log ? Math.exp(scaled) : scaled;
  }
}

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
