// Pictures of one run, as Python computed them: any panel of series, rules and bands becomes one chart.
const VEGA_SHAPES = { dots: "circle", point: "circle", circles: "circle", triangles: "triangle-up", crosses: "M-1,-1L1,1M1,-1L-1,1" };
const AREAS = { dots: 8, point: 70, circles: 40, triangles: 40, crosses: 30 };

function markOf({ mark, dashed }) {
  const clip = true, strokeDash = dashed ? [5, 3] : [1, 0];
  if (mark === "line" || mark === "steps") return { type: "line", interpolate: mark === "steps" ? "step-after" : "linear", strokeWidth: 1.4, strokeDash, clip };
  if (mark === "stems") return { type: "bar", width: 3, clip };
  return { type: "point", shape: VEGA_SHAPES[mark], filled: ["dots", "point"].includes(mark), size: AREAS[mark], opacity: 1, clip };
}

/** The Vega-Lite layers of a panel; what has a name is in the legend above it. */
function panelSpec({ x, y, logX, logY, equal, rangeX, rangeY, series, rules = [], bands = [] }) {
  const named = [...bands, ...rules.map((rule) => ({ ...rule, colour: "#1a1a1a" })), ...series].filter(({ name }) => name);
  const legend = { domain: named.map(({ name }) => name), range: named.map(({ colour }) => colour) };
  const colour = (part) => (part.name ? { datum: part.name, type: "nominal", scale: legend, legend: { title: null, orient: "top", columns: 2, labelLimit: 260 } } : { value: part.colour || "#1a1a1a" });
  const scale = (log, range) => ({ type: log ? "log" : "linear", ...(log ? {} : { zero: false }), nice: false, ...(range ? { domain: range } : { padding: 6 }) });
  const across = { field: "x", type: "quantitative", title: x, scale: scale(logX, rangeX) }, up = { field: "y", type: "quantitative", title: y, scale: scale(logY, rangeY) };
  const layer = bands.map((band) => ({ data: { values: band.x.map((value, k) => ({ x: value, y: band.low[k], y2: band.high[k] })) }, mark: { type: "area", opacity: 0.5, clip: true },
    encoding: { x: across, y: up, y2: { field: "y2" }, color: colour(band) } }));
  layer.push(...rules.map((rule) => ({ data: { values: [{}] }, mark: { type: "rule", strokeDash: [4, 3], clip: true },
    encoding: { ...(rule.x === undefined ? { y: { datum: rule.y } } : { x: { datum: rule.x } }), color: colour(rule) } })));
  layer.push(...series.map((part) => ({ data: { values: part.x.map((value, k) => ({ x: value, y: part.y[k], k })) }, mark: markOf(part),
    encoding: { x: across, y: up, color: colour(part), ...(part.mark === "line" ? { order: { field: "k" } } : {}) } })));
  return { layer, ...(equal ? { width: 280, height: 280 } : { height: 170 }) };
}

const NEAR = new IntersectionObserver((entries) => entries.forEach(async ({ target, isIntersecting }) => {
  if (!isIntersecting) return;
  NEAR.unobserve(target);
  await pause();
  vegaEmbed(target, shaded({ $schema: "https://vega.github.io/schema/vega-lite/v6.json", width: "container", config: LOOK, ...target.spec() }), { ...EMBED, actions: false });
}), { rootMargin: "300px" });

/** Places the pictures of a run; each chart is drawn when it comes near the screen. */
function placePictures(content, pictures) {
  for (const { name, title, panels } of pictures) {
    const charts = panels.map((panel) => {
      const chart = element("div", { class: "chart", role: "img", "aria-label": `${title}: ${panel.y} against ${panel.x}` });
      chart.spec = () => ({ description: chart.ariaLabel, ...panelSpec(panel) });
      NEAR.observe(chart);
      return [...(panel.title ? [element("span", { class: "note" }, panel.title)] : []), chart];
    });
    content.append(element("figure", { "data-picture": name }, element("figcaption", {}, title), ...charts.flat()));
  }
}
