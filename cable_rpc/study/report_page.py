"""What the HTML reports share: how a page is put together, headline figures, embedded pictures."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

from cable_rpc.errors import ConfigurationError


@dataclass(frozen=True, slots=True)
class Tile:
    """A headline figure."""

    label: str
    value: str
    detail: str


def render_page(template: str, **content: Any) -> str:
    """A page from one of the templates beside this module, plotly.js inlined; everything put in is escaped.

    Args:
        template: its path from this folder.
        content: what the template asks for; ``plotly_js`` is added.

    Raises:
        ConfigurationError: the ``study`` extra is not installed.
    """
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise study_extra_missing(error) from error
    environment = Environment(
        loader=PackageLoader("cable_rpc.study", "."),
        autoescape=select_autoescape(default=True),
        undefined=StrictUndefined,
    )
    plotly_js = get_plotlyjs().replace("</script>", "<\\/script>")
    return environment.get_template(template).render(plotly_js=plotly_js, **content)


def study_extra_missing(error: ImportError) -> ConfigurationError:
    """What to do about it."""
    return ConfigurationError(f"the report needs {error.name}: pip install 'cable-rpc[study]'")


def in_script(json_text: str) -> str:
    """JSON that can stand inside a script element, where ``<`` could end it or open a comment."""
    return json_text.replace("<", "\\u003c")


def jpeg_uri(picture: bytes) -> str:
    """A JPEG picture as a data URI."""
    return "data:image/jpeg;base64," + base64.b64encode(picture).decode("ascii")
