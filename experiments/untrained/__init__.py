"""What is reached without training: anchors of results, and towers from lists of drops."""
