"""Stone Soup's UKF and particle filter, and our EKF and UKF, on the same ranges and arrival angles.

python examples/stone_soup.py 50         (50 simulated episodes)
python examples/stone_soup.py 5 ride     (5 recorded episodes from the folder or sample `ride`)

Stone Soup's filters and `plain`, our UKF without gates, assume the same motion and noise, so Stone
Soup's UKF should give the same results as `plain`.
"""

import sys
from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
from stonesoup.models.measurement import nonlinear
from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.predictor.particle import ParticlePredictor
from stonesoup.resampler.particle import ESSResampler
from stonesoup.types.array import StateVector, StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState, ParticleState
from stonesoup.updater.kalman import UnscentedKalmanUpdater
from stonesoup.updater.particle import ParticleUpdater

from experiments.evaluation.agents import Estimator
from experiments.evaluation.compare import compare
from mmwave_env.filters.bank import default_modes
from mmwave_env.filters.pipeline import predict
from mmwave_env.filters.textbook import F
from mmwave_env.numerics.linalg import pack, unpack


class Ukf(Estimator):
    """Stone Soup's unscented Kalman filter."""

    predictor = KalmanPredictor

    def begin(self, mean, P, time):  # noqa: D102
        return GaussianState(mean, P, timestamp=time)

    def updater(self, model):  # noqa: D102
        return UnscentedKalmanUpdater(model, alpha=1.0, beta=2.0, kappa=0.0)

    def track(self, pipeline, site, epochs):  # noqa: D102
        time = datetime.min
        zero = [0.0] * len(site.prior_P)
        state = self.begin(np.array(site.prior_x), np.array(unpack(site.prior_P)), time)
        for epoch in epochs:
            if epoch.dt:
                time = time + timedelta(seconds=float(epoch.dt))
                mode = pipeline.modes[-1]
                Q = predict(pipeline, mode, site.prior_x, zero, 1.0, epoch, site.hz_per_mps)[1]
                moves = LinearGaussianTimeInvariantTransitionModel(
                    transition_matrix=F(epoch.dt), covariance_matrix=np.array(Q)
                )
                state = self.predictor(moves).predict(state, timestamp=time)
            state = self._updated(state, site, epoch)
            # Add (1 mm)^2, because the covariance is 0 if all particles agree.
            spread = np.array(state.covar) + 1e-6 * np.eye(7)
            yield np.array(state.mean, float).ravel(), pack(spread)

    def _updated(self, state, site, epoch):
        models = []
        values = []
        for link in np.flatnonzero(epoch.visible[:-1]):
            order = [4 * link + i for i in (2, 1, 0)]  # elevation, azimuth, range
            values += [epoch.z[i] for i in order]
            noise = [epoch.sigma[i] ** 2 for i in order]
            anchor = np.array([site.anchors[link]]).T
            of_link = nonlinear.CartesianToElevationBearingRange(
                7, (0, 1, 2), np.diag(noise), translation_offset=anchor
            )
            models.append(of_link)
        if not models:
            return state
        model = nonlinear.CombinedReversibleGaussianMeasurementModel(models)
        detection = Detection(StateVector(values), state.timestamp, measurement_model=model)
        return self.updater(model).update(SingleHypothesis(state, detection))


class Particles(Ukf):
    """Stone Soup's bootstrap particle filter, which is slow."""

    predictor = ParticlePredictor

    def begin(self, mean, P, time, count=500):  # noqa: D102
        cloud = StateVectors(np.random.default_rng(0).multivariate_normal(mean, P, count).T)
        return ParticleState(cloud, weight=np.full(count, 1.0 / count), timestamp=time)

    def updater(self, model):  # noqa: D102
        return ParticleUpdater(model, resampler=ESSResampler())


if __name__ == "__main__":
    episodes = int(sys.argv[1])
    data = next(iter(sys.argv[2:]), None)
    plain = replace(default_modes("handset")[1], gate=None, adaptive=False)
    rivals = {
        "stone-soup-ukf": Ukf(),
        "stone-soup-particle": Particles(),
        "plain": lambda observations: np.zeros(len(observations), int),
    }
    rows = ("range", "azimuth", "elevation")
    print(
        compare(
            rivals,
            ("fixed-ekf", "fixed-ukf"),
            episodes=episodes,
            data=data,
            modes=[plain],
            measurements=rows,
        )
    )
