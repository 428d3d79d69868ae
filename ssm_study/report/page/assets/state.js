"use strict";
// What the reader has chosen, and which runs that leaves. Everything else draws from here.
const DATA = JSON.parse(document.getElementById("data").textContent);
const RUNS = (DATA.columns.run || []).length; // all different, so never coded
// Where few values differ, each once and which of them stands where; nowhere, if all are the same.
const decoded = (column) =>
  Array.isArray(column)
    ? column
    : column.at.length
      ? column.at.map((k) => column.values[k])
      : Array(RUNS).fill(column.values[0]);
const COLUMNS = Object.fromEntries(
  Object.entries(DATA.columns).map(([name, column]) => [name, decoded(column)]),
);

const state = {
  text: "",
  verdicts: new Set(DATA.verdicts.map((v) => v.word)),
  selects: {},
  range: { column: "", low: null, high: null },
  brushes: {},
  sort: { column: null, descending: false },
  page: 0,
  allColumns: false,
  chosen: -1,
  colour: "",
  group: { by: null, metric: null },
  picked: new Set(),
};

const ALL_TEXT = Array.from({ length: RUNS }, (_, i) =>
  Object.keys(COLUMNS)
    .filter((name) => typeof COLUMNS[name][i] === "string")
    .map((name) => COLUMNS[name][i])
    .join(" ")
    .toLowerCase(),
);

function within(value, low, high) {
  return value != null && (low === null || value >= low) && (high === null || value <= high);
}

/** 1 for each run that passes every filter and every brush. */
function mask() {
  const words = state.text.toLowerCase().split(/\s+/).filter(Boolean);
  const selects = Object.entries(state.selects).filter(([, value]) => value !== "");
  const brushes = Object.values(state.brushes).flatMap((brush) => Object.entries(brush));
  const ranged = state.range.column && (state.range.low !== null || state.range.high !== null);
  return Array.from({ length: RUNS }, (_, i) =>
    Number(
      state.verdicts.has(COLUMNS.verdict[i]) &&
        words.every((word) => ALL_TEXT[i].includes(word)) &&
        selects.every(([name, value]) => String(setting(name, i)) === value) &&
        (!ranged || within(COLUMNS[state.range.column][i], state.range.low, state.range.high)) &&
        brushes.every(([name, [low, high]]) => within(COLUMNS[name][i], low, high)),
    ),
  );
}

const ALPHABET = new Intl.Collator(); // ten times faster than localeCompare
const listeners = [];
let waiting = false;

/** Redraw once per frame however fast the filters change: a brush fires with every pixel. Each listener hears which
 * runs are shown and whether that is news; the first, the table, is on the screen before the others begin. */
function changed(keepPage = false) {
  if (!keepPage) state.page = 0;
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(async () => {
    waiting = false;
    const shown = mask(),
      news = !state.shown || shown.some((here, i) => here !== state.shown[i]);
    if (news) state.shown = shown;
    for (const listener of listeners) {
      listener(state.shown, news);
      await pause();
    }
  });
}

/** Let the page draw a frame and take a key or a click before the next piece of work. */
function pause() {
  return new Promise((done) => {
    setTimeout(done);
  });
}

function element(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value === true) node.setAttribute(name, "");
    else if (value !== false && value !== null) node.setAttribute(name, value);
  }
  node.append(...children);
  return node;
}

function printed(value) {
  if (value == null) return "–"; // a column that is not there, too
  if (typeof value === "boolean") return value ? "yes" : "no";
  if (typeof value !== "number" || Number.isInteger(value)) return String(value);
  if (value !== 0 && Math.abs(value) < 1e-3) return value.toExponential(2);
  const short = Number(value.toPrecision(4));
  return short === 1 ? besideOne(value) : String(short); // one is the bound of margins and radii
}

/** Two digits, or as many as keep the number on its side of one. */
function besideOne(number) {
  for (let digits = 2; digits < 16; digits += 1) {
    const text = Number(number.toPrecision(digits));
    if (Math.sign(text - 1) === Math.sign(number - 1)) return String(text);
  }
  return String(number);
}

/** A column's name without its unit. */
function shortWord(name) {
  return DATA.words[name].replace(/ \(.*/, "");
}

/** A value of the table; a prediction never stands without its doubt. */
function cellOf(name, i) {
  const value = COLUMNS[name][i],
    evidence = COLUMNS.evidence && COLUMNS.evidence[i];
  if (name !== "predicted_stable") return printed(value);
  if (evidence === "cannot judge") return evidence;
  return value && evidence === "doubt" ? "yes, doubt" : printed(value);
}

function isNumeric(name) {
  return COLUMNS[name].some((value) => typeof value === "number") && !isText(name);
}

/** By size where both are numbers, else by the alphabet. */
function inOrder(a, b) {
  return typeof a === "number" && typeof b === "number"
    ? a - b
    : ALPHABET.compare(String(a), String(b));
}

/** Words that need room; a yes or no does not. */
function isText(name) {
  return COLUMNS[name].some((value) => typeof value === "string");
}

/** The options of a menu of columns, by the part of the study that they describe; what never varies is left out. */
function columnOptions(selected) {
  const telling = (name) =>
    COLUMNS[name] &&
    isNumeric(name) &&
    new Set(COLUMNS[name].filter((value) => value !== null)).size > 1;
  return Object.entries(DATA.menus)
    .map(([title, names]) => [title, names.filter(telling)])
    .filter(([, names]) => names.length)
    .map(([title, names]) =>
      element(
        "optgroup",
        { label: title },
        ...names.map((name) =>
          element("option", { value: name, selected: name === selected }, DATA.words[name]),
        ),
      ),
    );
}

const SHAPES = {
  // by Vega's names for them
  circle: "M7 1a6 6 0 1 0 .01 0z",
  "triangle-up": "M7 1l6 11H1z",
  "triangle-left": "M1 7l11-6v12z",
  "triangle-right": "M13 7L2 1v12z",
  square: "M2 2h10v10H2z",
  "triangle-down": "M7 13L1 2h12z",
  cross: "M5 1h4v4h4v4H9v4H5V9H1V5h4z",
  diamond: "M7 0l5 7-5 7-5-7z",
  // in the legend of a picture, by the names of its marks
  line: "M0 7h28",
  band: "M2 1h24v12H2z",
  stems: "M13 1h3v12h-3z",
  dots: "M14 5a2 2 0 1 0 .01 0z",
  point: "M14 2a5 5 0 1 0 .01 0z",
  circles: "M14 3a4 4 0 1 0 .01 0z",
  triangles: "M14 3l4 8h-8z",
  crosses: "M10 3l8 8M18 3l-8 8",
};

function symbolOf(path, look, box) {
  const [svg, drawn] = ["svg", "path"].map((tag) =>
    document.createElementNS("http://www.w3.org/2000/svg", tag),
  );
  svg.setAttribute("viewBox", box);
  svg.setAttribute("aria-hidden", "true");
  for (const [name, value] of Object.entries({ d: path, ...look })) drawn.setAttribute(name, value);
  svg.append(drawn);
  return svg;
}

function marker(word) {
  const { shape: mark, colour } = DATA.verdicts.find((v) => v.word === word);
  return symbolOf(SHAPES[mark], { fill: shade(colour) }, "0 0 14 14");
}
