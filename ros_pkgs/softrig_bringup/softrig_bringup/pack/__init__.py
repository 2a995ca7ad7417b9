"""Files that repeat a run or a study on another machine: contents, permission to run their code, signatures."""
