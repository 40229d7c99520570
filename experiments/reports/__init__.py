"""From run directories to figures and tables with the paper's numbers beside them."""
