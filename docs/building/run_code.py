"""Run the code of the guide: `python docs/building/run_code.py [PAGE.md or NOTEBOOK.ipynb ...]`.

Every page's ```python blocks are one session, in a folder of its own. What a page takes as given (a problem, a log) is
made by files in ``before/``, in the same session. A block that cannot run has ``<!-- not run: REASON -->`` above it,
which readers do not see. Notebooks run in a kernel of their own, as a user runs them.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

DOCS = Path(__file__).resolve().parent.parent
REPOSITORY = DOCS.parent
BEFORE = Path(__file__).resolve().parent / "before"
#: What pages take as given.
GIVEN = {
    "README.md": ("rig.py",),
    "docs/calibrate.md": ("rig.py",),
    "docs/files.md": ("rig.py", "result.py"),
    "docs/methods.md": ("rig.py", "methods.py"),
}
#: Pages whose blocks are no sessions, and why.
NOT_RUN = {
    "docs/changes.md": "it compares folders of two calibrations; tests/results has its calls",
    "docs/corners.md": "the corners are the reader's; examples/from_corners.py goes this way, and is tested",
    "docs/from_a_log.md": "it takes a minute of detection; tests/runs goes the same way",
    "docs/refinement.md": "the corners are the reader's; examples/from_corners.py goes this way, and is tested",
    "factors/README.md": "its graph is the reader's; examples/slam_graph.py is a whole one, and is tested",
}
#: A session that takes longer has hung.
MOST_SECONDS = 120
_BLOCK = re.compile(r"(?:<!-- not run: (?P<why>[^\n]+) -->\n)?^```python\n(?P<code>.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(text: str) -> list[tuple[int, str, str]]:
    """Line, code and reason for not running it ("": it runs) of a page's blocks."""
    return [
        (text[: found.start("code")].count("\n") + 1, found["code"], found["why"] or "")
        for found in _BLOCK.finditer(text)
    ]


def session_of(page: Path) -> str:
    """The page's session: what it takes as given, then its blocks, each at its own line of the page."""
    parts = []
    for name in GIVEN.get(str(page.relative_to(REPOSITORY)), ()):
        given = BEFORE / name
        parts.append(f"exec(compile({given.read_text(encoding='utf-8')!r}, {str(given)!r}, 'exec'))\n")
    for line, code, why in blocks(page.read_text(encoding="utf-8")):
        if not why:  # line breaks before the code, so that a traceback has the page's lines
            placed = "\n" * (line - 1) + code
            parts.append(f"exec(compile({placed!r}, {str(page)!r}, 'exec'))\n")
    return "".join(parts)


def run_page(page: Path) -> str:
    """What went wrong, or ""."""
    session = session_of(page)
    paths = [str(REPOSITORY), str(REPOSITORY / "factors"), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "REPOSITORY": str(REPOSITORY), "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-W", "error::RuntimeWarning", "-c", session],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=MOST_SECONDS,
            check=False,
        )
    return done.stderr if done.returncode else ""


def run_notebook(path: Path) -> str:
    """What went wrong, or ""."""
    import nbformat
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError

    notebook = nbformat.read(path, as_version=4)
    try:
        NotebookClient(
            notebook, timeout=MOST_SECONDS, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}
        ).execute()
    except CellExecutionError as error:
        return str(error)
    return ""


def pages() -> list[Path]:
    """All pages that have Python, and the notebooks."""
    found = [REPOSITORY / "README.md", REPOSITORY / "factors" / "README.md", *sorted(DOCS.glob("*.md"))]
    found += sorted((DOCS / "mathematics").glob("*.md"))
    found = [page for page in found if str(page.relative_to(REPOSITORY)) not in NOT_RUN]
    with_code = [page for page in found if any(not why for *_place, why in blocks(page.read_text(encoding="utf-8")))]
    return [*with_code, *sorted((REPOSITORY / "examples" / "notebooks").glob("*.ipynb"))]


def main() -> int:
    """Run what is asked for, or all; 1 if something fails."""
    failed = 0
    for page in [Path(argument).resolve() for argument in sys.argv[1:]] or pages():
        said = run_notebook(page) if page.suffix == ".ipynb" else run_page(page)
        failed += bool(said)
        print(f"{'FAILED' if said else 'ran'}: {page.relative_to(REPOSITORY)}", flush=True)
        if said:
            print(said)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
