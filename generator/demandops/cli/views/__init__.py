"""Commands that show: bookkeeping, history, reasons, status."""
