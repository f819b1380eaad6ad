"""From measured cells to the rows of both tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from cable_rpc.study.metrics import Bootstrap, mean_or_none
from cable_rpc.study.sequence_metrics import pool
from cable_rpc.study.tables.cells import Cell
from cable_rpc.study.tables.data_sets import paper_order, title_of
from cable_rpc.study.tables.equal_quality import pool_equal_quality
from cable_rpc.study.tables.paper_values import COMPARISON_DATA_SET, CROSS_DATA_SET, STRATEGIES, PaperRow
from cable_rpc.study.tables.result_table import Column, ResultTable, Row, Value
from cable_rpc.study.tables.table_columns import ACROSS_DATA_SETS, ACROSS_STRATEGIES, Measure, PooledCells

AVERAGE = "average"
Pooled = Mapping[tuple[str, str], PooledCells]
"""(data set, strategy) to all sequences that were measured; only what has any."""
Parts = Sequence[tuple[str, Sequence[Measure]]]


def pooled_cells(cells: Sequence[Cell], bootstrap: Bootstrap | None = None) -> Pooled:
    """Join the sequences of each data set under each strategy, in the order of the paper's rows."""
    groups: dict[tuple[str, str], list[Cell]] = {}
    for cell in cells:
        if cell.metrics is not None:
            groups.setdefault((cell.request.dataset, cell.strategy), []).append(cell)
    keys = sorted(groups, key=lambda key: paper_order(key[0]))
    return {
        key: PooledCells(
            pool([cell.metrics for cell in groups[key] if cell.metrics is not None], bootstrap=bootstrap),
            pool_equal_quality([cell.equal_quality for cell in groups[key]], bootstrap),
        )
        for key in keys
    }


def table_one(
    pooled: Pooled, strategy: str, *, by_frame: bool, mode: str = "", notes: Sequence[str] = ()
) -> ResultTable:
    """One strategy across data sets, each with the paper's row below it.

    Args:
        pooled: of `pooled_cells`.
        strategy: the one to show.
        by_frame: True averages over frames as the paper does.
        mode: the ROI settings' name, for the caption.
        notes: what a reader must know.
    """
    rows: list[Row] = []
    ours: list[Row] = []
    for (dataset, name), found in pooled.items():
        if name != strategy:
            continue
        ours.append(Row(title_of(dataset), figures(found, ACROSS_DATA_SETS, by_frame=by_frame)))
        rows += [ours[-1], *printed_rows(f"{title_of(dataset)} (paper)", CROSS_DATA_SET.get(dataset))]
    if len(ours) > 1:
        rows.append(Row("average", averages(ours)))
        rows += printed_rows("average (paper)", CROSS_DATA_SET[AVERAGE])
    caption = f"Across data sets: strategy {strategy}, {averaging(by_frame, mode)}"
    return ResultTable("table1", "I", caption, "data set", parts_of(ACROSS_DATA_SETS), rows, notes)


def table_two(
    pooled: Pooled, strategies: Sequence[str], *, by_frame: bool, mode: str = "", notes: Sequence[str] = ()
) -> ResultTable:
    """Strategies beside each other, a block for each data set; the paper has one of nuScenes.

    Args:
        pooled: of `pooled_cells`.
        strategies: in the order of the rows.
        by_frame: True averages over frames as the paper does.
        mode: the ROI settings' name, for the caption.
        notes: what a reader must know.
    """
    rows: list[Row] = []
    for dataset in dict.fromkeys(key[0] for key in pooled):
        block = title_of(dataset)
        for strategy in strategies:
            found = pooled.get((dataset, strategy))
            if found is not None:
                rows.append(Row(strategy, figures(found, ACROSS_STRATEGIES, by_frame=by_frame), block=block))
            if dataset == COMPARISON_DATA_SET:
                rows += printed_rows(f"{strategy} (paper)", STRATEGIES.get(strategy), block)
    if all(dataset != COMPARISON_DATA_SET for dataset, _ in pooled):
        block = f"{title_of(COMPARISON_DATA_SET)} (paper)"
        for strategy in strategies:
            rows += printed_rows(strategy, STRATEGIES.get(strategy), block)
    caption = f"Across strategies: {averaging(by_frame, mode)}"
    return ResultTable("table2", "II", caption, "strategy", parts_of(ACROSS_STRATEGIES), rows, notes)


def averaging(by_frame: bool, mode: str) -> str:
    """What was averaged, and how."""
    how = "averaged over frames as the paper does" if by_frame else "pooled over frames"
    return f"{mode} mode, {how}" if mode else how


def parts_of(parts: Parts) -> list[tuple[str, list[Column]]]:
    """The columns of each part."""
    return [(caption, [measure.column for measure in measures]) for caption, measures in parts]


def figures(found: PooledCells, parts: Parts, *, by_frame: bool) -> dict[str, Value]:
    """A row's figures by column."""
    return {
        measure.column.key: measure.value(found, by_frame=by_frame) for _, measures in parts for measure in measures
    }


def printed_rows(label: str, printed: PaperRow | None, block: str = "") -> Iterator[Row]:
    """The paper's row, if there is one."""
    if printed is not None:
        yield Row(label, {key: Value(value) for key, value in printed.items()}, "paper", block)


def averages(rows: Sequence[Row]) -> dict[str, Value]:
    """Plain means of the rows that have a figure, as the paper's last row; nothing for counts."""
    keys = dict.fromkeys(key for row in rows for key in row.cells if key not in ("sequences", "frames"))
    return {key: Value(mean_or_none(row.cells[key].estimate for row in rows if key in row.cells)) for key in keys}
