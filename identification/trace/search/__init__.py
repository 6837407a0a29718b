"""Select effects: screening, forward selection, backward elimination, held-out tests."""
