"""A strategy's whole loop in one process, lock-step, through real messages: what tables, sweeps and figures measure."""
