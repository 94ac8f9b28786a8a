"""Muon for the weights of hidden layers and Adam for the rest, as in src/train/optimizer.rs."""

import torch

_CLIP, _MOMENTUM, _SIZE, _ITERATIONS, _COEFFICIENTS = 1.0, 0.95, 0.2, 5, (3.4445, -4.7750, 2.0315)


def orthogonal(matrix):
    """Roughly the nearest orthogonal matrix, by the Newton and Schulz iteration with Jordan's
    coefficients."""
    x = matrix / matrix.norm().clamp(min=1e-30)
    tall = x.shape[0] > x.shape[1]
    x = x.T if tall else x
    a, b, c = _COEFFICIENTS
    for _ in range(_ITERATIONS):
        gram = x @ x.T
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x.T if tall else x


class Optimizer:
    """Updates all parameters that want gradients; `hidden` are those that Muon updates."""

    def __init__(self, parameters, hidden, weight_decay):
        learned = [p for p in parameters if p.requires_grad]
        of_muon = {id(p) for p in hidden}
        self.hidden = [p for p in learned if id(p) in of_muon]
        self.momenta = [torch.zeros_like(p) for p in self.hidden]
        self.adam = torch.optim.Adam([p for p in learned if id(p) not in of_muon])
        self.learned, self.weight_decay = learned, weight_decay

    @torch.no_grad()
    def step(self, lr):
        """One step. Without a finite gradient it is skipped, and False is returned."""
        norm = torch.nn.utils.clip_grad_norm_(self.learned, _CLIP)
        if not torch.isfinite(norm):
            return False
        for group in self.adam.param_groups:
            group["lr"] = lr
        self.adam.step()
        for p, momentum in zip(self.hidden, self.momenta):
            momentum.mul_(_MOMENTUM).add_(p.grad)
            if not p.grad.any():  # cut off by ReLUs: momentum alone moves nothing
                continue
            rows, columns = p.shape[0], p[0].numel()
            direction = orthogonal((momentum * _MOMENTUM + p.grad).reshape(rows, columns))
            p.mul_(1 - lr * self.weight_decay)
            p.sub_(direction.reshape(p.shape), alpha=lr * _SIZE * max(rows, columns) ** 0.5)
        return True

    def zero(self):
        for p in self.learned:
            p.grad = None

    def state(self):
        return {"adam": self.adam.state_dict(), "momenta": self.momenta}

    def load(self, state):
        self.adam.load_state_dict(state["adam"])
        for mine, kept in zip(self.momenta, state["momenta"]):
            mine.copy_(kept)
