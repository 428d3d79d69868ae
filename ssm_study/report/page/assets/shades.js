// Light or dark, as the reader's system asks: the style sheet follows by itself, the plots are told here.
const DARK = matchMedia("(prefers-color-scheme: dark)").matches;
document.documentElement.classList.toggle("night", DARK);
const AT_NIGHT = {
  "#1A1A1A": "#E6E6E6",
  "#6B6B6B": "#A6A6A6",
  "#E6E6E6": "#363B41",
  "#D9D9D9": "#3C4248",
  "#0072B2": "#4BA3E3",
};

/** A colour of the light page as this reader sees it. */
function shade(colour) {
  return (DARK && AT_NIGHT[colour.toUpperCase()]) || colour;
}

/** A specification in the reader's colours; its data stay as they are. */
function shaded(spec) {
  if (!DARK) return spec;
  const ink = shade("#1a1a1a"),
    quiet = shade("#6b6b6b"),
    words = { labelColor: ink, titleColor: ink };
  const painted = JSON.parse(
    JSON.stringify(spec, (key, value) => {
      if (key === "values" || key === "datasets") return undefined; // put back below
      if (key === "scheme") return { name: value.name || value, extent: [0.3, 1] }; // without the shades that sink into the ground
      return typeof value === "string" ? shade(value) : value;
    }),
  );
  const config = painted.config || {};
  painted.config = {
    ...config,
    background: "#16181B",
    axis: { ...words, domainColor: quiet, tickColor: quiet, ...config.axis },
    legend: words,
  };
  if (spec.datasets) painted.datasets = spec.datasets;
  if (spec.data && spec.data.values) painted.data = spec.data;
  (spec.layer || []).forEach((layer, i) => {
    if (layer.data && layer.data.values) painted.layer[i].data = layer.data;
  });
  return painted;
}
