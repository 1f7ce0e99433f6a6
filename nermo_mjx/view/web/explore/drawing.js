// Drawing primitives: canvases at the screen's resolution, points, rings, shortened names.

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
      paper.beginPath();
      paper.moveTo(middle - r, middle - r);
      paper.lineTo(middle + r, middle + r);
      paper.moveTo(middle + r, middle - r);
      paper.lineTo(middle - r, middle + r);
      paper.stroke();
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
