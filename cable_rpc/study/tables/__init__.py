"""The paper's two tables, measured: cells of sequence and strategy, pooled to rows, drawn for terminal and print."""
