// The table: sorted by a click on a heading, filtered with the plots, 25 runs at a time.
const PAGE = 25;

function visibleColumns() {
  const known = DATA.known_columns.filter((name) => COLUMNS[name] && (RUNS === 1 || varies(name)));
  const first = DATA.first.filter((name) => COLUMNS[name]);
  return [...new Set(state.allColumns ? [...first, ...known] : first)];
}

function sorted(rows) {
  const { column, descending } = state.sort;
  if (column === null) return rows; // the table comes best first
  const values = COLUMNS[column],
    sign = descending ? -1 : 1;
  return rows.sort((i, j) => {
    const a = values[i],
      b = values[j];
    if (a == null || b == null) return (a == null) - (b == null) || i - j; // missing last, both ways
    return inOrder(a, b) * sign || i - j;
  });
}

function sortBy(column) {
  const same = state.sort.column === column;
  state.sort =
    same && state.sort.descending
      ? { column: null, descending: false }
      : { column, descending: same };
  changed();
}

function drawHead() {
  const names = visibleColumns(),
    said = JSON.stringify([names, state.sort]);
  if (said === drawHead.said) return; // a drag filters with every pixel and leaves the headings alone
  drawHead.said = said;
  document.getElementById("head").replaceChildren(
    element(
      "tr",
      {},
      ...names.map((name) => {
        const here = state.sort.column === name;
        const arrow = here ? (state.sort.descending ? " ▼" : " ▲") : "";
        return element(
          "th",
          {
            scope: "col",
            class: isText(name) ? "text" : "",
            "aria-sort": here ? (state.sort.descending ? "descending" : "ascending") : "none",
          },
          element(
            "button",
            { type: "button", "data-column": name, onclick: () => sortBy(name) },
            DATA.words[name] + arrow,
          ),
        );
      }),
    ),
  );
}

function drawRow(i, names) {
  return element(
    "tr",
    { class: i === state.chosen ? "chosen" : "", "data-run": String(i) },
    ...names.map((name) =>
      name === "run"
        ? element(
            "th",
            { scope: "row" },
            ...(RUNS > 1 ? [picker(i)] : []),
            element(
              "button",
              { type: "button", title: COLUMNS.run[i], onclick: () => choose(i) },
              ...nameParts(COLUMNS.run[i]),
            ),
          )
        : element("td", { class: isText(name) ? "text" : "" }, cellOf(name, i)),
    ),
  );
}

// Of a run's name only what not all runs share, and the digits.
const PARTS = (COLUMNS.run || []).map(partsOf),
  TELLING = (PARTS[0] || []).map(
    (part, k, all) =>
      RUNS === 1 ||
      k === all.length - 1 ||
      PARTS.some((own) => own.length !== all.length || own[k] !== part),
  );

function partsOf(name) {
  return printed(name)
    .replace(/^\.\.\//, "")
    .split("-");
}

/** `order4-0123456789` of `order4-width8-seed0-0123456789` where the order alone was varied. */
function shortName(name) {
  return partsOf(name)
    .filter((_, k) => TELLING[k] ?? true)
    .join("-");
}

/** A run's name in two parts; a phone shows the digits alone, which tell runs apart. */
function nameParts(name) {
  const [, settings, digits] = /^(.*-)([0-9a-f]{10})$/.exec(shortName(name)) || [
    null,
    "",
    shortName(name),
  ];
  return [element("span", { class: "settings" }, settings), digits];
}

/** A box that puts the run among those shown side by side. */
function picker(i) {
  return element("input", {
    type: "checkbox",
    class: "picker",
    "aria-label": `Compare ${COLUMNS.run[i]}`,
    checked: state.picked.has(i),
    onchange: (event) => {
      if (event.target.checked) state.picked.add(i);
      else state.picked.delete(i);
      drawSideBySide();
      keepInLink();
    },
  });
}

function drawTable(shown) {
  const place = focusedPlace();
  const rows = sorted([...shown.keys()].filter((i) => shown[i]));
  const pages = Math.max(1, Math.ceil(rows.length / PAGE));
  state.page = Math.min(state.page, pages - 1);
  state.order = rows;
  drawHead();
  const names = visibleColumns();
  document
    .getElementById("body")
    .replaceChildren(
      ...rows.slice(state.page * PAGE, (state.page + 1) * PAGE).map((i) => drawRow(i, names)),
    );
  drawPager(pages);
  const count = document.getElementById("count");
  if (count) count.textContent = `${rows.length} of ${RUNS} runs shown`;
  const again = place && document.querySelector(place);
  if (again) again.focus({ preventScroll: true });
}

/** Where the keyboard is in the table, as a selector: drawing anew must not lose it. */
function focusedPlace() {
  const here = document.activeElement,
    row = here && here.closest("tr[data-run]");
  if (row) return `tr[data-run="${row.dataset.run}"] button`;
  return here && here.dataset.column
    ? `[data-column="${here.dataset.column}"]`
    : here && here.closest("#pager")
      ? `#${here.id}`
      : null;
}

function drawPager(pages) {
  const turn = (by) => () => {
    state.page += by;
    changed(true);
  };
  document.getElementById("pager").replaceChildren(
    ...(pages === 1
      ? []
      : [
          element(
            "button",
            { type: "button", id: "page-before", onclick: turn(-1), disabled: state.page === 0 },
            "Previous",
          ),
          element("span", {}, `Page ${state.page + 1} of ${pages}`),
          element(
            "button",
            {
              type: "button",
              id: "page-after",
              onclick: turn(1),
              disabled: state.page >= pages - 1,
            },
            "Next",
          ),
        ]),
  );
}
