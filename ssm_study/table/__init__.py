"""Table of a study: gathered from its runs, filtered, ranked, printed."""
