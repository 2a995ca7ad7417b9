import softrig_core as softrig_core  # before numpy is loaded: it pins what numpy chooses by CPU
