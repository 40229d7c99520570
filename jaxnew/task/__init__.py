"""A domain: what it is, what may be spent on it, how it is shown, and the settings of its runs."""
