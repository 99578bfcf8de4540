"""The scripts that run while the documentation is built: tutorial, how-to pages and the gallery of the examples.

They are copied to `_build/scripts` first, so that what they write stays there; from there sphinx-gallery runs them, two
at a time. Pictures are the PNG files that a script writes. One that fails, or prints nothing, ends the build.
"""

from __future__ import annotations

import re
import shutil
from fnmatch import fnmatch
from itertools import combinations
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from PIL import Image
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

DOCS = Path(__file__).resolve().parent.parent
EXAMPLES = DOCS.parent / "examples"
OWN = DOCS / "scripts"
COPIES = DOCS / "_build" / "scripts"

# Sections of the gallery, in order: folder, title, text, scripts. Every example must be in one of them.
GALLERY = (
    (
        "first",
        "First steps",
        "Small problems, each with one idea.",
        ("first_order_lag", "plain_problems", "final_variance", "free_terminal_time", "launch_vehicle"),
    ),
    (
        "identification",
        "Moving in order to learn",
        "The input decides what is known of the unknown constants at the end.",
        (
            "identification_weights",
            "damped_oscillator",
            "tradeoff_sweep",
            "chain_of_masses",
            "noisy_integrator",
            "unknown_gain",
            "designed_excitation",
            "attitude_slew",
            "bought_sensor",
            "position_fixes",
            "experiment_then_steering",
        ),
    ),
    (
        "closed_loop",
        "Closed loop",
        "Nominal, filter and feedback chosen together, and what the actual system makes of it.",
        (
            "closed_loop_lag",
            "worth",
            "constrained_gain",
            "covariance_steering",
            "corridor",
            "incorrect_statistics",
            "monte_carlo",
            "own_law",
            "receding_horizon",
            "tracking_in_the_wind",
            "mars_entry",
        ),
    ),
    (
        "blocks",
        "Laws by themselves",
        "Filters and laws from `covocp.blocks`, in simulations of their own.",
        (
            "theta_d_regulation",
            "theta_d_tracking",
            "gain_scheduling",
            "adaptive_regulator",
            "model_reference",
            "peak_seeking_line",
            "formation_flight",
            "antenna_pointing",
        ),
    ),
    (
        "c",
        "C code",
        "Controllers, filters, laws and a whole solver as C99, compiled and compared with Python.",
        (
            "export_lag_controller",
            "export_mars_controller",
            "export_replanning",
            "export_kalman_dropouts",
            "export_theta_d",
            "export_peak_seeker",
            "export_attitude_seeking",
        ),
    ),
)
HOWTO = (
    "covariance_constraint",
    "decisions",
    "closed_loop",
    "other_truth",
    "custom_law",
    "warm_starts",
    "export",
)
ORDER = [name for *_, names in GALLERY for name in names]
HEADER = "GALLERY_HEADER.rst"
EXPORTS = "export_c("
PRINTED = "rst-class:: sphx-glr-script-out"
FULL_WIDTH = 9.0  # of a picture that fills the width of a page [inch]
NO_PICTURE = COPIES / "no_picture.png"


class ListedOrder:
    """The order of the tables above, within a folder."""

    def __init__(self, folder: str) -> None:
        """Choose the table of a folder."""
        self.names = HOWTO if Path(folder).name == "howto" else ORDER

    def __call__(self, file: str) -> int:
        """Place of a script."""
        return self.names.index(Path(file).stem) if Path(file).stem in self.names else -1


def named_pictures(script: Path) -> list[str]:
    """Patterns of the PNG files that a script names: others run beside it in the same folder."""
    return [re.sub(r"\{\w+\}", "*", name) for name in re.findall(r'"([\w{}]+\.png)"', script.read_text("utf-8"))]


def written_pictures(block: Any, variables: dict[str, Any], settings: dict[str, Any]) -> str:
    """The PNG files that the last lines of a script wrote, oldest first, one below the other."""
    script, text = Path(variables["src_file"]), ""
    names = named_pictures(script)
    own = [path for path in script.parent.glob("*.png") if any(fnmatch(path.name, name) for name in names)]
    for picture in sorted(own, key=lambda path: path.stat().st_mtime_ns):
        place = Path(next(variables["image_path_iterator"]))
        shutil.move(picture, place)
        address = place.resolve().relative_to(settings["src_dir"]).as_posix()
        words = picture.stem.replace("_", " ")
        text += (
            f"\n.. image:: /{address}\n   :alt: {words}\n   :width: {share(place)}%\n   :class: sphx-glr-single-img\n"
        )
    return text


def share(picture: Path) -> int:
    """Percent of the width of a page at which the letters of all pictures have the same size."""
    with Image.open(picture) as image:
        inches = image.width / image.info.get("dpi", (100, 100))[0]
    return min(100, round(100 * inches / FULL_WIDTH))


def tidy(settings: dict[str, Any], script: str | None) -> None:
    """Remove the folders of exported code beside a page that has one: they are no sections of a gallery.

    Scripts that run at the same time write none: in sections, whose folders are not looked through, they may.
    """
    for path in COPIES.glob(f"*/{Path(script).name}") if script else ():
        if EXPORTS in path.read_text("utf-8"):
            for folder in path.parent.iterdir():
                if folder.is_dir():
                    shutil.rmtree(folder)


SETTINGS = {
    "examples_dirs": [str(COPIES / name) for name in ("tutorial", "howto", "gallery")],
    "gallery_dirs": ["tutorial", "howto", "gallery"],
    "subsection_order": [f"_build/scripts/gallery/{folder}" for folder, *_ in GALLERY],
    "within_subsection_order": "scripts.ListedOrder",
    "filename_pattern": r"\.py$",
    "image_scrapers": ["scripts.written_pictures"],
    "reset_modules": ["matplotlib", "scripts.tidy"],
    "reset_modules_order": "after",
    "parallel": 2,
    "default_thumb_file": str(NO_PICTURE),
    "abort_on_example_error": True,
    "capture_repr": (),
    "doc_module": ("covocp",),
    "notebook_extensions": set(),
    "download_all_examples": False,
    "show_signature": False,
    "write_computation_times": False,
    "min_reported_time": 1,
}


def copy_scripts() -> None:
    """The folders that sphinx-gallery reads, and none of its pages whose script is gone."""
    listed, found = sorted(ORDER), sorted(path.stem for path in EXAMPLES.glob("*.py"))
    if listed != found:
        raise ExtensionError(f"docs/_extensions/scripts.py lists {listed}, but examples/ has {found}")
    shutil.rmtree(COPIES, ignore_errors=True)
    for name in ("tutorial", "howto"):
        shutil.copytree(OWN / name, COPIES / name)
    for folder, title, text, names in GALLERY:
        section = COPIES / "gallery" / folder
        section.mkdir(parents=True)
        (section / HEADER).write_text(f"{title}\n{'-' * len(title)}\n\n{text}\n", encoding="utf-8")
        for name in names:
            shutil.copy(EXAMPLES / f"{name}.py", section)
    shutil.copy(OWN / "gallery" / HEADER, COPIES / "gallery")
    for one, other in combinations(sorted(COPIES.rglob("*.py")), 2):
        names = [named_pictures(script) for script in (one, other)]
        if one.parent == other.parent and any(fnmatch(a, b) or fnmatch(b, a) for a in names[0] for b in names[1]):
            raise ExtensionError(f"{one.name} and {other.name} write a picture of the same name")
    for gallery in ("tutorial", "howto", "gallery"):
        pages = {path.relative_to(DOCS).with_suffix("") for path in (DOCS / gallery).rglob("*.py")}
        scripts = {path.relative_to(COPIES).with_suffix("") for path in (COPIES / gallery).rglob("*.py")}
        if pages - scripts:
            shutil.rmtree(DOCS / gallery)
    no_picture = Figure(figsize=(4, 2.8))
    no_picture.text(0.5, 0.5, "C99", size=60, color="0.6", family="monospace", ha="center", va="center")
    no_picture.savefig(NO_PICTURE, dpi=100)


def check_shown(app: Sphinx) -> None:
    """A script that prints nothing shows nothing, and a picture whose name no script tells is on no page."""
    left = [str(picture.relative_to(COPIES)) for picture in COPIES.rglob("*/*.png")]
    if left:
        raise ExtensionError(f"{left} are on no page: scripts must name their pictures")
    for copy in COPIES.rglob("*.py"):
        page = DOCS / copy.relative_to(COPIES).with_suffix(".rst")
        if PRINTED not in page.read_text(encoding="utf-8"):
            raise ExtensionError(f"{copy.relative_to(COPIES)} printed nothing")


def setup(app: Sphinx) -> dict[str, Any]:
    """Copy at once: sphinx-gallery looks at its folders when the configuration is read. Check when it has run."""
    copy_scripts()
    app.connect("builder-inited", check_shown, priority=900)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
