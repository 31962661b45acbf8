"""The report of a run: figures, numbers and what to distrust, on one page that needs nothing else."""
