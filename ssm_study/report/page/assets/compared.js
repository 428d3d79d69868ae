// What one run compared on its own model and plant: controllers by situation, or many certified designs.
const spoken = (choice) => DATA.choices[choice] || String(choice).replaceAll("_", " ");

function rowsOf(compared) {
  const names = Object.keys(compared);
  return compared[names[0]].map((_, k) => Object.fromEntries(names.map((name) => [name, compared[name][k]])));
}

function percent(share) {
  return share == null ? "–" : `${Math.round(100 * share)} %`;
}

/** Controllers down; across the numbers of the one situation, or all situations. */
function controllersTable(compared) {
  const rows = rowsOf(compared), situations = [...new Set(compared.situation)], controllers = [...new Set(compared.controller)];
  const one = situations.length === 1;
  const heads = one ? ["Settled", "Mean settling (s)", "Worst (s)", "Peak input", "Mismatch margin", "Certified"] : situations.map(spoken);
  const body = controllers.map((controller) => {
    const own = rows.filter((row) => row.controller === controller);
    const cells = one ? numbersOf(own[0]) : situations.map((situation) => settledCell(own.find((row) => row.situation === situation)));
    return element("tr", {}, element("th", { scope: "row" }, spoken(controller)), ...cells);
  });
  const head = element("tr", {}, ...["Controller", ...heads].map((name, k) => element("th", { scope: "col", class: k ? "" : "text" }, name)));
  const caption = one ? "Controllers on this run's plant, from the same starts" : "Controllers on this run's plant: share settled, mean settling time of those";
  return element("figure", {}, element("figcaption", {}, caption),
    element("div", { class: "scroll compared", tabindex: "0", role: "region", "aria-label": caption },
      element("table", {}, element("thead", {}, head), element("tbody", {}, ...body))));
}

function numbersOf(row) {
  const told = [percent(row.stable_fraction), ...["settling_time_mean_s", "settling_time_worst_s", "input_peak_v", "mismatch_margin"].map((name) => printed(row[name]))];
  return [...told, row.certified ? "yes" : "–"].map((text) => element("td", row.reason ? { title: row.reason } : {}, text));
}

/** The fewer settle the darker; the number says it too. */
function settledCell(row) {
  if (!row || row.stable_fraction == null) return element("td", {}, "–");
  const time = row.settling_time_mean_s == null ? "" : `${printed(row.settling_time_mean_s)} s`;
  return element("td", { style: `background: rgb(179 89 0 / ${Math.round(45 * (1 - row.stable_fraction))}%)` },
    percent(row.stable_fraction), element("br"), time);
}

/** Each certified design as a point: what its margin predicted against what the plant did. */
function designsChart(content, compared) {
  const rows = rowsOf(compared).map((row) => ({ margin: row.mismatch_margin, share: row.stable_fraction ?? row.stable_count / row.initial_conditions }))
    .filter(({ margin, share }) => margin > 0 && Number.isFinite(share));
  const above = rows.filter(({ margin }) => margin > 1), settled = (some) => some.filter(({ share }) => share >= 1).length;
  const below = rows.length - above.length, belowSettled = settled(rows) - settled(above);
  const note = `Above margin one ${settled(above)} of ${above.length} bring every start to rest, at or below it ${belowSettled} of ${below}.`;
  const axis = (field, title, scale) => ({ field, type: "quantitative", title, scale });
  const layer = [
    { data: { values: [{}] }, mark: { type: "rule", strokeDash: [4, 3], color: "#6b6b6b" }, encoding: { x: { datum: 1 } } },
    { data: { values: rows }, mark: { type: "point", filled: true, size: 25, opacity: 0.5, color: "#0072b2", aria: false }, encoding: {
      x: axis("margin", "Mismatch margin (–)", { type: "log" }), y: axis("share", "Starts settled (share)", { domain: [-0.05, 1.05], nice: false }) } }];
  const said = "Share of starts settled on the plant against mismatch margin, one point per certified design";
  return placeChart(content, [`${rows.length} certified designs for this model`, note], said, () => ({ layer }));
}
