"""Identify a plant from logs: records -> nonparametric, subspace, greybox -> trace."""
