// Pointer and keys on the plot: hovering, selecting and brushing.

import { element } from "viewer/elements.js";

/** A pointer movement below this is a click [pixels]. */
const STILL = 5;

/** `choose(place)` with a run, -1 for none; `brush(rectangle of shares or null)`. */
export function wirePointing(chart, tip, said, choose, brush) {
  const { marks } = chart;
  let start = null;
  const at = (event) => {
    const { left, top } = marks.getBoundingClientRect();
    return [event.clientX - left, event.clientY - top];
  };
  const point = (item, speak = false) => {
    chart.current = item;
    chart.mark();
    fillTip(chart, tip, item);
    if (speak && item) said.textContent = tip.innerText.replaceAll("\n", ", ");
  };
  const rectangle = (x, y) => [Math.min(start[0], x), Math.min(start[1], y), Math.abs(x - start[0]), Math.abs(y - start[1])];
  const moved = (x, y) => start && Math.hypot(x - start[0], y - start[1]) > STILL;

  marks.addEventListener("pointermove", (event) => {
    const [x, y] = at(event);
    if (!start) point(chart.hit(x, y));
    else if (moved(x, y) && event.pointerType !== "touch") {
      tip.hidden = true;
      chart.mark(rectangle(x, y));
    }
  });
  marks.addEventListener("pointerleave", () => !start && point(null));
  marks.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    start = at(event);
    marks.setPointerCapture(event.pointerId);
  });
  marks.addEventListener("pointercancel", () => (start = null));
  marks.addEventListener("pointerup", (event) => {
    if (!start) return;
    const [x, y] = at(event);
    const brushed = moved(x, y) && event.pointerType !== "touch" ? rectangle(x, y) : null;
    start = null;
    if (brushed) brush(shares(chart.frame, brushed));
    else {
      const item = chart.hit(x, y);
      choose(item ? item.place : -1);
      point(item);
    }
    chart.mark();
  });
  marks.addEventListener("dblclick", () => brush(null));
  marks.addEventListener("blur", () => point(null));
  marks.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if ((event.key === "Enter" || event.key === " ") && chart.current) choose(chart.current.place);
    else {
      const item = stepped(chart, event.key);
      if (item === undefined) return;
      if (item) point(item, true);
    }
    event.preventDefault();
  });
}

/** A rectangle of pixels as shares of the axes: `[left, right, bottom, top]`. */
function shares({ left, top, width, height }, [x, y, w, h]) {
  return [(x - left) / width, (x + w - left) / width, 1 - (y + h - top) / height, 1 - (y - top) / height];
}

/** The item that a key moves to; null if there is none, undefined for other keys. */
function stepped(chart, key) {
  const { items } = chart;
  const { field } = chart.colouring;
  const ranks = { PageDown: 1, PageUp: -1, Home: -Infinity, End: Infinity };
  const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  if (!(key in ranks) && !(key in ways)) return undefined;
  if (!items.length) return null;
  const from = chart.current ?? chart.itemOf(chart.chosen);
  const value = (item) => (field.isText ? item.place : field.cost(item.value ?? field.values[item.place]));
  if (key in ranks || !from) {
    const ordered = items.map((item) => [value(item), item]).sort(([a, p], [b, q]) => (a === b ? p.place - q.place : a - b)).map(([, item]) => item);
    const at = from && Number.isFinite(ranks[key]) ? ordered.indexOf(from) + ranks[key] : key === "End" ? ordered.length - 1 : 0;
    return ordered[Math.min(Math.max(at, 0), ordered.length - 1)];
  }
  return nearest(items, from, ways[key]);
}

/** The nearest item in a direction: sideways distance counts twice, and items more sideways than ahead are skipped. */
function nearest(items, from, [dx, dy]) {
  let [best, least] = [null, Infinity];
  for (const item of items) {
    const [x, y] = [item.x - from.x, item.y - from.y];
    const [ahead, aside] = [dx * x + dy * y, Math.abs(dy * x) + Math.abs(dx * y)];
    if (ahead < 0.5 || aside > ahead + 0.5) continue;
    const away = ahead + 2 * aside;
    if (away < least) [best, least] = [item, away];
  }
  return best;
}

function fillTip(chart, tip, item) {
  tip.hidden = !item;
  if (!item) return;
  const { table, view } = chart;
  const lines = [item.places?.length > 1 ? `${item.places.length} runs; row ${table.rows[item.place]}` : `row ${table.rows[item.place]}`];
  const { field } = chart.colouring;
  if (item.places?.length > 1) {
    const what = field.isText ? "most often" : { best: field.best, mean: "mean", worst: field.better ? "worst" : "lowest" }[view.of];
    lines.push(`${field.title}, ${what}: ${field.shown(item.value)}`);
  }
  const names = new Set([view.x, view.y, ...(item.places?.length > 1 ? [] : [view.colour])]);
  for (const name of names) lines.push(`${table.field(name).title}: ${table.field(name).shownAt(item.place)}`);
  const status = table.field("status");
  if (status && status.shownAt(item.place) !== "ok") lines.push(status.shownAt(item.place));
  tip.replaceChildren(...lines.map((line, i) => element(i ? "div" : "b", line)));
  const { clientWidth: width, clientHeight: height } = tip.parentElement;
  const right = item.x > width / 2;
  tip.style.left = right ? "auto" : `${item.x + 14}px`;
  tip.style.right = right ? `${width - item.x + 14}px` : "auto";
  tip.style.top = `${Math.min(Math.max(item.y - 20, 2), height - tip.offsetHeight - 2)}px`;
}
