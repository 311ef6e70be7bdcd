"""The camera with its true parameters: parts, effects, skip rules, ledger, hardware, laboratory."""
