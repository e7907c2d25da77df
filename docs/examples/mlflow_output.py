"""A federation's numbers in MLflow, by an output format of Stable-Baselines3's logger."""

import sys

import mlflow
import numpy as np
from stable_baselines3.common.logger import HumanOutputFormat, KVWriter, Logger

from sb3_fedguide import FedAvg


class MLflowOutputFormat(KVWriter):
    """Every scalar as a metric of the active run; text and pictures stay out."""

    def write(self, key_values, key_excluded, step=0):
        numbers = {
            key: float(value)
            for key, value in key_values.items()
            if "mlflow" not in (key_excluded.get(key) or ()) and isinstance(value, (int, float, np.number))
        }
        mlflow.log_metrics(numbers, step=step)

    def close(self):
        pass


model = FedAvg("MlpPolicy", "Bandit2D", rollout_size=200, seed=0)
model.set_logger(Logger(None, [HumanOutputFormat(sys.stdout), MLflowOutputFormat()]))
with mlflow.start_run():
    mlflow.log_params({"algo": "FedAvg", "env": "Bandit2D", "seed": 0})
    model.learn(total_timesteps=3 * 4 * 200)
