"""The report page of a study: one HTML file that opens from disk, with no server and no network."""

from pathlib import Path
from typing import Any

from ssm_study.refusal import BadRequest
from ssm_study.report.page_data import asset, best_ordered, page_data, script_json
from ssm_study.report.study_folder import Study

SCRIPTS = ("state.js", "shades.js", "plots.js", "table.js", "compared.js", "run.js", "main.js")


def write_page(study_folder: Path) -> Path:
    """Write `study_folder/report.html`; returns its path. Needs the extra `report` (Altair and its bundled Vega).

    The file carries data, style, scripts and the plotting library; its content policy forbids any request.
    """
    study = Study(folder=study_folder)
    data = page_data(study) | _plots(study)
    parts = {
        "title": study.name,
        "style": asset("page.css"),
        "data": script_json(data),
        "library": _library(),
        "script": "\n".join(asset(name) for name in SCRIPTS),
    }
    html = asset("page.html")
    for name, content in parts.items():
        html = html.replace(f"<!--{name}-->", content, 1)
    path = study_folder / "report.html"
    path.write_text(html, encoding="utf-8")
    return path


def _plots(study: Study) -> dict[str, Any]:
    try:
        from ssm_study.report.page_charts import EXPLORER, panels, specification
    except ImportError as error:
        raise BadRequest(
            "report", "page", f"{error.name} is not installed", "pip install 'ssm-study[report]'"
        ) from error
    table = best_ordered(study.table)
    return {"panels": panels(table), "explorer": specification(EXPLORER, table)}


def _library() -> str:
    """Vega, Vega-Lite and vega-embed as one script, out of the wheel."""
    import altair
    import vl_convert

    version = ".".join(altair.SCHEMA_VERSION.removeprefix("v").split(".")[:2])
    bundle: str = vl_convert.javascript_bundle(vl_version=version)  # type: ignore[call-arg]  # the stub has no default
    return bundle.replace("</script", "<\\/script")
