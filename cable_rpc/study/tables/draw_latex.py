r"""A result table in LaTeX: one ``table*`` for each part, set with booktabs (``\usepackage{booktabs}``)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby

from cable_rpc.study.tables.draw_terminal import rows_of_part
from cable_rpc.study.tables.result_table import NOT_MEASURED, Column, ResultTable, Row

ESCAPES = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "%": r"\%",
        "&": r"\&",
        "#": r"\#",
        "_": r"\_",
        "$": r"\$",
        "{": r"\{",
        "}": r"\}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "×": r"$\times$",
        "±": r"$\pm$",
        "≥": r"$\geq$",
        "–": "--",
        "·": r"$\cdot$",
    }
)


def draw_latex(table: ResultTable) -> str:
    """All parts and the intervals as floats; ends with a line feed."""
    floats = [
        float_lines(table, f"{table.caption}; {caption}.", f"{table.key}-{number}", columns)
        for number, (caption, columns) in enumerate(table.parts, 1)
    ]
    columns = table.columns_with_intervals()
    if columns:
        caption = f"{table.caption}; 95 % intervals."
        floats.append(float_lines(table, caption, f"{table.key}-intervals", columns, intervals=True))
    notes = [f"% {note}" for note in table.notes]
    head = [r"% Needs \usepackage{booktabs}.", *notes]
    return "\n\n".join("\n".join(lines) for lines in [head, *floats]) + "\n"


def float_lines(
    table: ResultTable, caption: str, label: str, columns: Sequence[Column], *, intervals: bool = False
) -> list[str]:
    """One float."""
    lines = [
        r"\begin{table*}[t]",
        r"\centering",
        rf"\caption{{{escaped(caption)}}}",
        rf"\label{{tab:{label}}}",
        r"\small",
        r"\setlength{\tabcolsep}{4pt}",
        rf"\begin{{tabular}}{{l{'r' * len(columns)}}}",
        r"\toprule",
        *group_lines(columns),
        " & ".join([escaped(table.label_heading), *(escaped(column.name) for column in columns)]) + r" \\",
        r"\midrule",
    ]
    lines += body_lines(table, columns, intervals)
    return [*lines, r"\bottomrule", r"\end{tabular}", r"\end{table*}"]


def group_lines(columns: Sequence[Column]) -> Iterator[str]:
    """Headings over neighbours that belong together, each underlined; nothing where no column has one."""
    if not any(column.group for column in columns):
        return
    cells, rules, place = [""], [], 2
    for group, members in groupby(columns, key=lambda column: column.group):
        count = len(list(members))
        cells.append(rf"\multicolumn{{{count}}}{{c}}{{{escaped(group)}}}" if group else " & ".join([""] * count))
        if group:
            rules.append(rf"\cmidrule(lr){{{place}-{place + count - 1}}}")
        place += count
    yield " & ".join(cells) + r" \\"
    yield " ".join(rules)


def body_lines(table: ResultTable, columns: Sequence[Column], intervals: bool) -> Iterator[str]:
    """The rows, blocks set apart."""
    started = False
    for row, is_first in rows_of_part(table, columns):
        if intervals and row.source != "ours":
            continue
        if is_first and row.block:
            if started:
                yield r"\midrule"
            yield rf"\multicolumn{{{len(columns) + 1}}}{{l}}{{\textbf{{{escaped(row.block)}}}}} \\"
        started = True
        yield " & ".join(row_texts(row, columns, intervals)) + r" \\"


def row_texts(row: Row, columns: Sequence[Column], intervals: bool) -> list[str]:
    """A row's cells; printed figures in italics."""
    texts = [escaped(row.label)]
    for column in columns:
        shown = row.interval_text(column) if intervals else row.text(column)
        texts.append("--" if shown == NOT_MEASURED else shown.replace("-", "$-$"))
    return [rf"\textit{{{text}}}" for text in texts] if row.source == "paper" else texts


def escaped(text: str) -> str:
    """Plain text for LaTeX."""
    return text.translate(ESCAPES)
