"""Learning: estimate noise and systematic errors (`Params`) from logs by maximum likelihood.

Read in this order:
- `likelihood`: the log likelihood of a log under the filter, and its score (gradient).
- `transforms`: the free scale, on which every real number is an allowed value of a parameter.
- `data`: windows of logs, and one configuration for all of them.
- `fit`: climb the score with Adam; stop by held-out logs. `checkpoint`: save and resume a fit.
- `uncertainty`: standard errors, and what the logs leave unresolved.
- `report`: the tables, sentences and figures of a fit.
"""
