"""Export: a stage as other programs take it whole, and whether they would."""
