import softrig_core as softrig_core  # first: in a node it pins what numpy chooses by CPU
