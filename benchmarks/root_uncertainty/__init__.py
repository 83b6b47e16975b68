"""Protocol Root uncertainty: a tracker of root hypotheses against SIR and the annealed filter."""
