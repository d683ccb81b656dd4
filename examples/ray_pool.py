"""An executor of your own: the workers of a Ray cluster, on which the same packages are installed.

ray start --head --port 6379                                   # on one machine
ray start --address 10.0.0.1:6379                              # on each other one
RAY_ADDRESS=10.0.0.1:6379 \\
    sparseskin reprocess day*.mcap --out results --executor ray_pool:pool

Without an address Ray uses the cores of this host. Who reaches its ports has code run by its
workers: keep them on a network of your own.
"""

from concurrent.futures import Executor


class RayPool(Executor):
    """Tasks of a Ray cluster as futures."""

    def submit(self, function, /, *args, **kwargs):
        import ray

        # One core a task. One whose worker died fails, as with the other executors.
        task = ray.remote(max_retries=0)(function)
        return task.remote(*args, **kwargs).future()

    def shutdown(self, wait=True, *, cancel_futures=False):
        import ray

        ray.shutdown()


def pool():
    """All workers of the cluster at RAY_ADDRESS."""
    import ray

    ray.init(log_to_driver=False)
    return RayPool()
