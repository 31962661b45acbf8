"""Network weights: which files are known, where they are found, and how they come here."""
