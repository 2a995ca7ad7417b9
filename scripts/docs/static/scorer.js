// Pages that people have written before what the code writes of itself; what leads somebody by the hand first.
var Scorer = {
  score: ([page, , , , score]) =>
    /^reference\/(softrig_|nodes\/)/.test(page) ? score - 1000 : score + ({ tutorials: 12, "how-to": 6 }[page.split("/")[0]] ?? 0),
  objNameMatch: 11, objPartialMatch: 6, objPrio: { 0: 15, 1: 5, 2: -5 }, objPrioDefault: 0,
  title: 15, partialTitle: 7, term: 5, partialTerm: 2,
};
