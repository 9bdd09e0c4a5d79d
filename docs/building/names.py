"""Names in Python, wherever they are written, lead to their descriptions in the reference.

Docstrings name things as their module knows them (`Problem.add`), and annotations as they are defined
(``gtsam_rwhec.problem.problem.Problem``): both lead to the public name. In the pages `rw.calibrate` does.
A name in a docstring or an annotation that the reference lacks (a parameter, another library's class) is shown as code.
"""

from __future__ import annotations

import re
from itertools import takewhile

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util.nodes import find_pending_xref_condition, make_refnode

from building.api_pages import DESCRIBED

_IN_PAGES = re.compile(r"(rw|gtsam_rwhec|rwhec_factors)((?:\.[A-Za-z_]\w*)+)(?:\(.*\))?", re.DOTALL)


def public_names(name: str, near: str = "") -> list[str]:
    """Names that the reference may have for one that somebody wrote, the likeliest first.

    Parameters
    ----------
    name
        As written: by its module's own words, by where it is defined, or as `rw.name`.
    near
        The module of who wrote it. Of several things of one name the one defined nearest to it counts.
    """
    parts = name.split(".")
    found = []
    for place, part in enumerate(parts):
        written = ".".join(parts[:place])
        for (module, last), public in DESCRIBED.items():
            if last == part and (not written or f".{module}".endswith(f".{written}")):
                pairs = zip(module.split("."), near.split("."), strict=False)
                shared = sum(1 for _both in takewhile(lambda both: both[0] == both[1], pairs))
                found.append((-shared, ".".join([public, *parts[place + 1 :]])))
    return [re.sub(r"^rw\.", "gtsam_rwhec.", name), *(public for _shared, public in sorted(found))]


def _place(env: BuildEnvironment, names: list[str]) -> tuple[str, str] | None:
    """The page and the anchor of the first of these names that is described."""
    domain = env.domains.python_domain
    for name in names:
        if name in domain.objects:
            return domain.objects[name].docname, domain.objects[name].node_id
        if name in domain.modules:
            return domain.modules[name].docname, domain.modules[name].node_id
    return None


class NamesInTheReference(SphinxPostTransform):
    """Names in docstrings and annotations lead to their descriptions; those without one are code."""

    default_priority = 5  # before Sphinx's own, which knows a name by its package alone

    def run(self, **_: object) -> None:
        """Go through one page."""
        if not self.env.docname.startswith("made/api/"):
            return
        modules = {public: module for (module, _last), public in DESCRIBED.items()}
        for reference in list(self.document.findall(pending_xref)):
            if reference.get("refdomain") != "py":
                continue
            name, package = reference["reftarget"], reference.get("py:module") or ""
            inside = f"{package}.{reference.get('py:class') or ''}".rstrip(".")
            near = modules.get(".".join(inside.split(".")[: package.count(".") + 2]), package)
            found = _place(self.env, [f"{inside}.{name}", f"{package}.{name}", *public_names(name, near)])
            content = find_pending_xref_condition(reference, "resolved" if found else "*")
            shown = list(content.children if content is not None else reference.children)
            if found:
                link = make_refnode(self.app.builder, self.env.docname, *found, shown)
                reference.replace_self(link)
            else:
                reference.replace_self(shown)


class LinkedNames(SphinxPostTransform):
    """Code in the pages that is a public name becomes a link."""

    default_priority = 200

    def run(self, **_: object) -> None:
        """Go through one page."""
        for literal in list(self.document.findall(nodes.literal)):
            match = _IN_PAGES.fullmatch(literal.astext())
            linked = isinstance(literal.parent, (nodes.reference, pending_xref)) or "xref" in literal["classes"]
            found = _place(self.env, public_names(match[1] + match[2])) if match and not linked else None
            if found:
                literal.replace_self(make_refnode(self.app.builder, self.env.docname, *found, literal.deepcopy()))


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect to Sphinx."""
    app.add_post_transform(NamesInTheReference)
    app.add_post_transform(LinkedNames)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
