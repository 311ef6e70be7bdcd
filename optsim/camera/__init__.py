"""The camera with its true parameters: parts, effects, skip table, ledger, hardware, laboratory."""
