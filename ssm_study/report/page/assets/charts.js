// Charts that Python specified: placed at once, drawn by Vega when they come near the screen.
const EMBED = {
  actions: { export: { svg: true, png: true }, source: false, compiled: false, editor: false },
  renderer: "canvas",
  tooltip: { theme: DARK ? "dark" : "light" },
};

const WAITING = new Set(); // charts that are not drawn yet
const NEAR = new IntersectionObserver(
  (entries) => entries.forEach(({ target, isIntersecting }) => isIntersecting && drawChart(target)),
  { rootMargin: "300px" },
);

/** Charts take the width that an opened run leaves them. */
const WIDTH = new ResizeObserver(async (entries) => {
  for (const { target } of entries) {
    const fits = target.spec.width !== "container" || target.drawnWidth === target.clientWidth;
    if (fits || !target.clientWidth) continue;
    target.drawnWidth = target.clientWidth;
    await pause();
    await target.view.width(target.clientWidth).runAsync();
  }
});

async function drawChart(target) {
  if (!WAITING.delete(target)) return;
  NEAR.unobserve(target);
  await pause();
  const { view } = await vegaEmbed(target, shaded(target.spec), { ...EMBED, actions: false });
  target.view = view;
  target.drawnWidth = target.clientWidth;
  WIDTH.observe(target);
  target.dispatchEvent(new Event("drawn"));
}

/** Draws what nobody has scrolled to yet, so that a print or a picture of the whole page is complete. */
async function drawRest() {
  for (const target of WAITING) {
    await new Promise(requestIdleCallback);
    if (target.clientWidth) await drawChart(target);
  }
}

const AROUND = 45; // pixels that axis and title add to a chart's height

/** A place for a chart, as high as it will be, so that nothing moves when it is drawn; its accessible name is the
 * specification's description. */
function chartOf(spec) {
  const chart = element("div", { class: "chart", style: `min-height: ${spec.height + AROUND}px` });
  chart.spec = { ...DATA.look, ...spec };
  WAITING.add(chart);
  NEAR.observe(chart);
  return chart;
}

function figureOf(title, charts, note = "", attributes = {}) {
  const more = note ? [element("span", { class: "note" }, note)] : [];
  return element("figure", attributes, element("figcaption", {}, title, ...more), ...charts);
}

/** A name beside the mark with which the chart draws it. */
function legendEntry([name, mark, colour, dashes]) {
  const hollow = ["line", "circles", "triangles", "crosses"].includes(mark);
  const paint = hollow ? { fill: "none", stroke: shade(colour) } : { fill: shade(colour) };
  if (mark === "band") paint.opacity = 0.5;
  const look = { ...paint, "stroke-width": 1.6, "stroke-dasharray": dashes };
  return element("span", {}, symbolOf(SHAPES[mark], look, "0 0 28 14"), name);
}

/** Places the pictures of a run. */
function placePictures(content, pictures) {
  for (const { name, title, caption, charts } of pictures) {
    const parts = charts.flatMap((part) => [
      ...(part.title ? [element("span", { class: "note" }, part.title)] : []),
      element("div", { class: "legend" }, ...part.legend.map(legendEntry)),
      chartOf(part.spec),
    ]);
    parts.push(element("details", {}, element("summary", {}, charts.length ? "What it shows" : "Why"), caption));
    content.append(figureOf(title, parts, "", { "data-picture": name }));
  }
}

/** Lines over time after a template; `range` fixes the axis of values, so that pictures compare. The axis of time does
 * not follow the rows: the chart keeps it when a slider takes them away. */
function linesOf(template, title, label, datasets, range) {
  const spec = structuredClone(DATA.templates[template]);
  const end_s = datasets.rows.reduce((latest, { t }) => Math.max(latest, t), 0);
  spec.description = `${title}: ${label} against time`;
  spec.datasets = datasets;
  if (!datasets.band) spec.layer.shift();
  for (const { data, encoding } of spec.layer) {
    if (data.name === "band") continue;
    encoding.x.scale = { domain: [0, end_s], nice: false };
    encoding.y.title = label;
    if (template === "signals") colourSignals(encoding.color, datasets.rows);
    if (range) encoding.y.scale = { domain: range, nice: false };
  }
  return chartOf(spec);
}

/** The measured signal in grey, every run in its own colour, whether or not something was measured. */
function colourSignals(colour, rows) {
  const kinds = [...new Set(rows.map(({ kind }) => kind))];
  colour.scale.domain = ["measured", ...kinds.filter((kind) => kind !== "measured")];
  colour.legend.values = kinds;
}

function unpack({ step, rows, steps }) {
  const bytes = Uint8Array.from(atob(steps), (c) => c.charCodeAt(0));
  const values = new Int16Array(bytes.buffer);
  const length = values.length / rows;
  const row = (r) => Array.from(values.subarray(r * length, (r + 1) * length), (v) => v * step);
  return Array.from({ length: rows }, (_, r) => row(r));
}

/** One row per sample; `rank` orders the starts by the first value of `outputs`. */
function overTime(signals, step_s, kind, outputs = signals) {
  const firsts = outputs.map((values) => values[0]);
  const ranks = firsts.map((first) => firsts.filter((other) => other < first).length);
  return signals.flatMap((values, start) =>
    values.map((value, k) => ({ t: k * step_s, value, case: start, rank: ranks[start], kind })),
  );
}

/** What the responses of these runs visit, at most as far again as the starts reach: a response
 * that diverges leaves the picture. */
function rangeOf(runs) {
  const loops = runs.map(loopOf);
  const signals = loops.flatMap((loop) => [...unpack(loop.y), ...unpack(loop.alone)]);
  const starts = [...signals.map((values) => values[0]), ...loops.map(({ goal }) => goal)];
  const low = Math.min(...starts);
  const high = Math.max(...starts);
  const span = high - low || 1;
  const seen = signals.flat();
  const least = seen.reduce((a, b) => Math.min(a, b), low);
  const most = seen.reduce((a, b) => Math.max(a, b), high);
  return [Math.max(least, low - span) - 0.1 * span, Math.min(most, high + span) + 0.1 * span];
}

function loopOf(i) {
  return (DATA.trajectories[COLUMNS.run[i]] || {}).loop;
}

function bandOf({ goal, band }) {
  return [{ low: goal - band, high: goal + band }];
}

function responsesOf(loop, packed, title, range) {
  const rows = overTime(unpack(packed), loop.step_s);
  return linesOf("responses", title, loop.output, { rows, band: bandOf(loop) }, range);
}
