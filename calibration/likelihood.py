"""Maximum likelihood for normal residuals of mean zero."""

import numpy as np
from scipy.optimize import minimize


def maximum_likelihood(moments, start, squares):
    """Fit parameters [p] to normal residuals of mean zero; returns them and their standard errors.

    `moments(p)`: residuals [n, d] and covariances [n, d, d]. Of parameters that are variances, with
    indices `squares`, square roots are returned. Standard errors are by the Fisher information.
    """
    scale = np.full(len(start), 0.01)
    scale[squares] = np.array(start)[squares]
    bounds = [(1e-8 if i in squares else None, None) for i in range(len(start))]

    def cost(q):
        e, cov = moments(q * scale)
        white = np.linalg.solve(cov, e[..., None])[..., 0]
        return (np.sum(e * white) + np.linalg.slogdet(cov)[1].sum()) / (2 * len(e))

    best = minimize(cost, np.array(start) / scale, method="L-BFGS-B", bounds=bounds).x * scale
    inverse, slopes = np.linalg.inv(moments(best)[1]), []
    for step in np.diag(1e-4 * scale):
        ends = zip(moments(best + step), moments(best - step), strict=True)
        slopes.append([(a - b) / (2 * step.sum()) for a, b in ends])
    means, covs = zip(*slopes, strict=True)
    white = [inverse @ cov for cov in covs]
    information = np.array([[np.einsum("na,nab,nb", d, inverse, e) for e in means] for d in means])
    information += [[np.einsum("nab,nba", a, b) / 2 for b in white] for a in white]
    error = np.sqrt(np.diag(np.linalg.pinv(information)))
    best[squares] = np.sqrt(best[squares])
    # Near zero the square root is not linear: the error is limited to the variance's own root.
    error[squares] = np.minimum(error[squares] / (2 * best[squares]), np.sqrt(error[squares]))
    return best, error
