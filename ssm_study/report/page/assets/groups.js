// Comparing: runs grouped by a setting with mean and spread over the rest, and chosen runs side by side.
const METRICS = ["settling_time_mean_s", "fit_test_percent", "stable_fraction", "resolved_margin", "rate_controller", "controller_gain_norm", "input_peak_v"];
const MOST_GROUPS = 40;

const known = (values) => values.filter((value) => typeof value === "number");
const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
const spread = (values) => {
  const middle = mean(values);
  return values.length < 2 ? null : Math.sqrt(values.reduce((sum, value) => sum + (value - middle) ** 2, 0) / (values.length - 1));
};

/** A setting as it was requested: for a rate that `auto` chose, `auto`. */
function setting(name, i) {
  const byAuto = name.startsWith("rate_") && COLUMNS.rates_chosen && String(COLUMNS.rates_chosen[i]).includes(name.slice(5));
  return byAuto ? "auto" : COLUMNS[name][i];
}

/** `{label: [run indices]}` of the shown runs, in the order of the settings' values. */
function grouped(by, shown) {
  const groups = new Map();
  for (const i of shown.keys()) {
    if (!shown[i]) continue;
    const label = by.map((name) => printed(setting(name, i))).join(" · ");
    if (groups.has(label)) groups.get(label).push(i); else groups.set(label, [i]);
  }
  return new Map([...groups].sort(([, [i]], [, [j]]) => by.reduce((said, name) => said || inOrder(setting(name, i), setting(name, j)), 0)));
}

/** `0.1883 ± 0.0014`: the spread to two digits, the mean as far as the spread reaches; rounding alone is no spread. */
function meanAndSpread(values) {
  if (!values.length) return "–";
  const middle = mean(values), short = printed(Number(middle.toPrecision(3))), wide = spread(values);
  if (wide === null) return short;
  if (wide <= 1e-9 * Math.abs(middle)) return `${short} ± 0`;
  const places = 1 - Math.floor(Math.log10(wide));
  return places < 0 || places > 6 ? `${short} ± ${printed(Number(wide.toPrecision(2)))}` : `${middle.toFixed(places)} ± ${wide.toFixed(places)}`;
}

function groupRow([label, runs], metrics) {
  const cells = metrics.map((name) => element("td", {}, meanAndSpread(known(runs.map((i) => COLUMNS[name][i])))));
  return element("tr", {}, element("th", { scope: "row" }, label), element("td", {}, String(runs.length)), ...cells);
}

/** A strip per group: every run a tick, the mean a bar; the axis logarithmic where one value would crush the rest. */
function strips(groups, metric, rows) {
  const all = known([...groups.values()].flat().map((i) => COLUMNS[metric][i]));
  if (!all.length) return element("p", { class: "quiet" }, "No run of these has this number.");
  const log = Math.min(...all) > 0 && Math.max(...all) > 20 * Math.min(...all), scale = log ? Math.log10 : (v) => v;
  const low = scale(Math.min(...all)), high = scale(Math.max(...all)), row = 26;
  const width = Math.min(640, Math.max(300, document.getElementById("groups").clientWidth)), letters = Math.max(...[...groups.keys()].map((label) => label.length));
  const left = Math.min(width / 3, 20 + 6.5 * letters), most = Math.floor(left / 6.5); // on a phone the letters stay legible
  const x = (v) => left + 10 + ((scale(v) - low) / (high - low || 1)) * (width - left - 40);
  const svg = shape("svg", { viewBox: `0 0 ${width} ${groups.size * row + 30}`, role: "img", class: "strips",
    "aria-label": `${DATA.words[metric]} by group, one tick per run, a bar at the mean` });
  [...groups].forEach(([label, runs], k) => {
    const y = k * row + row / 2, values = known(runs.map((i) => COLUMNS[metric][i]));
    svg.append(shape("text", { x: left, y: y + 4, class: "tick end" }, label.length > most ? `${label.slice(0, most - 1)}…` : label));
    svg.append(shape("line", { x1: left + 6, x2: width - 20, y1: y, y2: y, class: "rail" }));
    for (const place of new Set(values.map((value) => Math.round(2 * x(value)) / 2))) svg.append(shape("circle", { cx: place, cy: y, r: 4, class: "one" })); // one where many coincide
    if (runs.includes(0) && typeof COLUMNS[metric][0] === "number") svg.append(shape("circle", { cx: x(COLUMNS[metric][0]), cy: y, r: 7, class: "ring" }));
    if (!values.length) svg.append(shape("text", { x: left + 12, y: y - 3, class: "tick" }, "no run has this number"));
    else if (values.length > 1) svg.append(shape("line", { x1: x(mean(values)), x2: x(mean(values)), y1: y - 9, y2: y + 9, class: "mean" }));
  });
  for (const value of [Math.min(...all), Math.max(...all)]) svg.append(shape("text", { x: x(value), y: groups.size * row + 20, class: "tick middle" }, printed(Number(value.toPrecision(3)))));
  return element("figure", {}, element("figcaption", {}, DATA.words[metric], element("span", { class: "note" }, `Rows: ${rows}. One dot per run, a bar at the mean of several, a ring around the best run${log ? "; logarithmic axis" : ""}.`)), svg);
}

function drawGroups(shown, news) {
  const box = document.getElementById("groups"), { by, metric } = state.group, said = JSON.stringify(state.group);
  if (!news && drawGroups.said === said) return; // sorting concerns the table alone
  drawGroups.said = said;
  const groups = grouped(by, shown), metrics = METRICS.filter((name) => !by.includes(name) && COLUMNS[name] && known(COLUMNS[name]).length);
  const few = new Map([...groups].slice(0, MOST_GROUPS)), more = groups.size - few.size, names = by.map((name) => DATA.words[name]).join(" · ");
  const caption = `Mean ± standard deviation over the runs of each group, below them over all${more ? `; ${more} more groups are not shown` : ""}`;
  box.replaceChildren(strips(few, metric, names), element("p", { class: "quiet" }, `${caption}.`), element("div", { class: "scroll compared", tabindex: "0", role: "region", "aria-label": caption },
    element("table", {}, element("thead", {}, element("tr", {}, ...[names, "Runs", ...metrics.map((name) => DATA.words[name])].map((text) => element("th", { scope: "col" }, text)))),
      element("tbody", {}, ...[...few].map((group) => groupRow(group, metrics))),
      element("tfoot", {}, ...(groups.size > 1 ? [groupRow(["All", [...groups.values()].flat()], metrics)] : [])))));
}

function drawGroupForm() {
  const names = DATA.parameters.filter((name) => new Set(COLUMNS[name].map((_, i) => setting(name, i))).size <= MOST_GROUPS), metrics = METRICS.filter((name) => COLUMNS[name] && known(COLUMNS[name]).length);
  if (!names.length || !metrics.length) { document.getElementById("compare").hidden = true; return; }
  const kept = [state.group.by].flat().filter((name) => names.includes(name));
  state.group = { by: kept.length ? kept : [names.find((name) => name === "study") || names.find((name) => name !== "seed") || names[0]], metric: metrics.includes(state.group.metric) ? state.group.metric : metrics[0] };
  const box = (name) => element("label", {}, element("input", { type: "checkbox", value: name, checked: state.group.by.includes(name), onchange: (event) => {
    const by = names.filter((other) => (other === name ? event.target.checked : state.group.by.includes(other)));
    if (by.length) state.group.by = by; else event.target.checked = true; // one at least
    changed(true);
  } }), DATA.words[name].replace(/ \(.*/, ""));
  const metric = element("select", { "aria-label": "What is compared", onchange: (event) => { state.group.metric = event.target.value; changed(true); } },
    ...metrics.map((name) => element("option", { value: name, selected: name === state.group.metric }, DATA.words[name])));
  document.getElementById("group-form").append(element("label", {}, "Compare", metric), element("fieldset", {}, element("legend", {}, "by"), ...names.map(box)));
  listeners.push(drawGroups);
}

/** Chosen runs side by side: responses, then the settings and numbers in which they differ. */
function drawSideBySide() {
  const box = document.getElementById("side"), runs = [...state.picked].sort((i, j) => i - j);
  if (runs.length < 2) { box.replaceChildren(element("p", { class: "quiet" }, "Tick two or more runs in the table to see them side by side.")); return; }
  const differ = Object.keys(COLUMNS).filter((name) => name !== "run" && DATA.known_columns.includes(name) && new Set(runs.map((i) => printed(COLUMNS[name][i]))).size > 1);
  const pictures = runs.map((i) => { const found = DATA.trajectories[COLUMNS.run[i]];
    return found && found.loop ? responses(shortName(COLUMNS.run[i]), unpack(found.loop.y), found.loop, bounds(runs)) : null; }).filter(Boolean);
  const head = ["", ...runs.map((i) => shortName(COLUMNS.run[i]))].map((text) => element("th", { scope: "col" }, text));
  const rows = differ.map((name) => element("tr", {}, element("th", { scope: "row" }, DATA.words[name]), ...runs.map((i) => element("td", {}, printed(COLUMNS[name][i])))));
  const overlay = element("div", { class: "pictures" });
  placePictures(overlay, overlayPictures(runs));
  box.replaceChildren(overlay, element("div", { class: "responses" }, ...pictures), element("div", { class: "scroll compared", tabindex: "0", role: "region", "aria-label": "Chosen runs, what differs" },
    element("table", {}, element("thead", {}, element("tr", {}, ...head)), element("tbody", {}, ...rows))));
}

/** One range for all chosen runs, so that their pictures compare. */
function bounds(runs) {
  const loops = runs.map((i) => (DATA.trajectories[COLUMNS.run[i]] || {}).loop).filter(Boolean);
  return rangeOf(loops.map((loop) => unpack(loop.y)), loops.map((loop) => loop.goal));
}

/** The shown runs, all columns, as a file; a text that begins like a formula gets an apostrophe before it. */
function downloadTable() {
  const names = Object.keys(COLUMNS), cell = (value) => {
    const text = value == null ? "" : String(value), safe = typeof value === "string" && /^[=+\-@\t\r]/.test(text) ? `'${text}` : text;
    return /[",\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
  };
  const lines = [names.join(","), ...state.order.map((i) => names.map((name) => cell(COLUMNS[name][i])).join(","))];
  const link = element("a", { href: URL.createObjectURL(new Blob([`${lines.join("\n")}\n`], { type: "text/csv" })), download: `${DATA.study}.csv` });
  link.click();
  URL.revokeObjectURL(link.href);
}

/** The choices of the reader as the page's fragment, so that a link shows what its sender saw. */
function keepInLink() {
  const said = { text: state.text, selects: state.selects, range: state.range.column ? state.range : undefined, sort: state.sort.column ? state.sort : undefined,
    hidden: DATA.verdicts.map((v) => v.word).filter((word) => !state.verdicts.has(word)), group: state.group, picked: [...state.picked].map((i) => COLUMNS.run[i]) };
  history.replaceState(null, "", `#${encodeURIComponent(JSON.stringify(said))}`);
}

function readLink() {
  try {
    const said = JSON.parse(decodeURIComponent(location.hash.slice(1)));
    for (const key of ["text", "selects", "range", "sort", "group"]) if (said[key]) state[key] = said[key];
    (said.hidden || []).forEach((word) => state.verdicts.delete(word));
    state.picked = new Set((said.picked || []).map((name) => COLUMNS.run.indexOf(name)).filter((i) => i >= 0));
  } catch { /* an ordinary address, or one that was cut */ }
}
