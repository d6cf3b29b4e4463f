// What the site's search finds in the change log and in appendices comes behind what it finds on pages.
// The numbers are Sphinx's own (searchtools.js).
var Scorer = {
  score: ([page, , , , score]) => (/^(changelog|appendix)/.test(page) ? score / 2 : score),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
