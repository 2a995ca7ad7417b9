"""The method: from a record to the place of the fault and how far it can be trusted."""
