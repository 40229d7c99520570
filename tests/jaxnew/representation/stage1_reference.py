"""Stage 1 in plain NumPy, float64: loops, no vectorised cleverness.

Written from `docs/method.md`, "HVAE", "Objective of stage 1" and "Flat VAE".

Parameters come as the nested dict of the Flax modules.
"""

import numpy as np

MOVES = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])


def grid_recordings(num_actions, num_recordings, seed, num_moves=5):
    """uint8[A, S, num_moves + 1, 2]: each action is a sequence of moves, starts are random."""
    rng = np.random.default_rng(seed)
    moves = MOVES[rng.integers(0, 4, (num_actions, num_moves))]
    path = np.concatenate([np.zeros((num_actions, 1, 2), int), np.cumsum(moves, axis=1)], axis=1)
    start = rng.integers(8, 72, (num_actions, num_recordings, 1, 2))
    return (start + path[:, None]).astype(np.uint8)


def as_float64(tree):
    if isinstance(tree, dict):
        return {name: as_float64(value) for name, value in tree.items()}
    return np.asarray(tree, np.float64)


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x))


def relu(x):
    return np.maximum(x, 0.0)


def dense(p, x):
    return x @ p["kernel"] + p["bias"]


def res_block(p, x):
    e = x
    for layer in range(len(p)):
        e = dense(p[f"Dense_{layer}"], e if layer == 0 else relu(e))
    return relu(e + x)


def scalar_batch_norm(p, x):
    """Batch statistics over every number of x."""
    scale, bias = p["BatchNorm_0"]["scale"][0], p["BatchNorm_0"]["bias"][0]
    return (x - x.mean()) / np.sqrt(x.var() + 1e-3) * scale + bias


def scalar_batch_norm_running(p, stats, x):
    mean, var = stats["BatchNorm_0"]["mean"][0], stats["BatchNorm_0"]["var"][0]
    scale, bias = p["BatchNorm_0"]["scale"][0], p["BatchNorm_0"]["bias"][0]
    return (x - mean) / np.sqrt(var + 1e-3) * scale + bias


def lstm_step(p, x, hidden, cell):
    """One PyTorch LSTM step: gates in the order input, forget, candidate, output; two biases."""
    gates = x @ p["kernel_input"] + p["bias_input"] + hidden @ p["kernel_hidden"] + p["bias_hidden"]
    size = hidden.shape[-1]
    i, f, g, o = (gates[..., k * size : (k + 1) * size] for k in range(4))
    cell = sigmoid(f) * cell + sigmoid(i) * np.tanh(g)
    return sigmoid(o) * np.tanh(cell), cell


def lstm(p, x):
    """x [T, i] of one recording -> hidden states [T, E]."""
    size = p["kernel_hidden"].shape[0]
    hidden, cell, out = np.zeros(size), np.zeros(size), []
    for step in x:
        hidden, cell = lstm_step(p, step, hidden, cell)
        out.append(hidden)
    return np.array(out)


def encode_recording(p, x):
    """x [T, D] -> h [E]: two bidirectional layers, averaged over time and directions."""
    for layer in range(2):
        q = p[f"BiLSTMLayer_{layer}"]
        forward, backward = lstm(q["forward"], x), lstm(q["backward"], x[::-1])[::-1]
        x = np.concatenate([forward, backward], axis=1)
    size = forward.shape[1]
    return (x[:, :size] + x[:, size:]).mean(axis=0) / 2.0


def latent_mean(p, e):
    """Res, Res, Lin; the batch norm comes after, over the whole batch."""
    return dense(p["Dense_0"], res_block(p["ResBlock_1"], res_block(p["ResBlock_0"], e)))


def action_statistics(p, h):
    """h [B, S, E] -> [B, 2 dc] before the batch norm."""
    rows = []
    for recordings in h:
        e = [
            dense(p["Dense_1"], res_block(p["ResBlock_0"], relu(dense(p["Dense_0"], one))))
            for one in recordings
        ]
        rows.append(dense(p["Dense_2"], res_block(p["ResBlock_1"], np.mean(e, axis=0))))
    return np.array(rows)


def scales_of(x):
    """Mean, deviation and root mean square change of each of the D numbers of x [B, S, T, D]."""
    changes = (x[:, :, 1:] - x[:, :, :-1]).reshape(-1, x.shape[-1])
    x = x.reshape(-1, x.shape[-1])
    return x.mean(0), np.sqrt(x.var(0) + 1e-6), np.sqrt((changes**2).mean(0) + 1e-6)


def reading(x, scales, reads_changes):
    """What the encoder reads of x [T, D]."""
    mean, deviation, change = scales
    rows = []
    for t, step in enumerate(x):
        row = [(step - mean) / deviation]
        if reads_changes:
            row.append((step - x[max(t - 1, 0)]) / change)
        rows.append(np.concatenate(row))
    return np.array(rows)


def decode(
    p, g, first_step, num_steps, scales=(0.0, 1.0, 1.0), predicts_changes=False, num_categories=0
):
    """g [H], first_step [D] of one recording -> [T-1, D].

    `num_categories`: of one-hot blocks whose probabilities are fed back.
    """
    mean, deviation, change = scales
    state = np.zeros(g.shape), np.zeros(g.shape)
    step, out = first_step, []
    for t in range(num_steps - 1):
        seen = (step - mean) / deviation
        if num_categories and t:
            odds = np.exp(seen.reshape(-1, num_categories))
            seen = (odds / odds.sum(axis=1, keepdims=True)).ravel()
        u = res_block(p["before_lstm"], dense(p["read"], seen))
        state = lstm_step(p["lstm"], g * u, *state)
        written = dense(p["write"], res_block(p["after_lstm"], state[0]))
        step = step + change * written if predicts_changes else mean + deviation * written
        out.append(step)
    return np.array(out)


def learned_log_variance(p):
    return np.clip(p["likelihood_log_variance"], -4.0, 3.0)


def gaussian_log_density(x, mean, log_variance):
    return np.sum(
        -0.5 * np.log(2 * np.pi) - 0.5 * log_variance - (x - mean) ** 2 / (2 * np.exp(log_variance))
    )


def one_hot_log_likelihood(x, logits, num_categories):
    total = 0.0
    for start in range(0, len(x), num_categories):
        block = logits[start : start + num_categories]
        log_normaliser = np.log(np.sum(np.exp(block - block.max()))) + block.max()
        total += block[np.argmax(x[start : start + num_categories])] - log_normaliser
    return total


def gaussian_kl(mean, log_variance, prior_mean, prior_log_variance):
    variance, prior_variance = np.exp(log_variance), np.exp(prior_log_variance)
    return np.sum(
        0.5 * np.log(prior_variance / variance)
        + (variance + (mean - prior_mean) ** 2) / (2 * prior_variance)
        - 0.5
    )


def hvae(p, x, action_noise, observation_noise, num_categories=0, is_changed=False):
    """One training pass: (reconstruction, kl_action, kl_observation), each divided by B*S.

    `is_changed`: with all that jaxnew adds to the paper's, but for the weight of `kl_action`.
    """
    p, x = as_float64(p), np.asarray(x, np.float64)
    num_actions, num_recordings, num_steps, dim = x.shape
    scales = scales_of(x) if is_changed and not num_categories else (0.0, 1.0, 1.0)
    fed_back = num_categories if is_changed else 0
    h = np.array(
        [
            [encode_recording(p["encoder"], reading(one, scales, is_changed)) for one in rows]
            for rows in x
        ]
    )

    q = p["action_inference"]
    statistics = scalar_batch_norm(q["ScalarBatchNorm_0"], action_statistics(q, h))
    mean, log_variance = np.split(statistics, 2, axis=1)
    c = mean + np.exp(log_variance / 2) * action_noise

    q = p["observation_inference"]
    e = relu(dense(q["from_recording"], h) + dense(q["from_action"], c)[:, None])
    z_head = q["LatentHead_0"]
    z_mean = scalar_batch_norm(z_head["ScalarBatchNorm_0"], latent_mean(z_head, e))
    z = z_mean + np.exp(z_head["log_variance"] / 2) * observation_noise

    q = p["latent_prior"]
    prior_head = q["LatentHead_0"]
    e = relu(dense(q["Dense_0"], c))
    prior_mean = scalar_batch_norm(prior_head["ScalarBatchNorm_0"], latent_mean(prior_head, e))

    q = p["decoder_start"]
    predicted = np.zeros((num_actions, num_recordings, num_steps - 1, dim))
    for b, s in np.ndindex(num_actions, num_recordings):
        g = relu(dense(q["from_observation"], z[b, s]) + dense(q["from_action"], c[b]))
        predicted[b, s] = decode(
            p["decoder"], g, x[b, s, 0], num_steps, scales, is_changed, fed_back
        )
    if is_changed and not num_categories:
        likelihood = np.log(((x[:, :, 1:] - predicted) ** 2).reshape(-1, dim).mean(axis=0))
    elif not num_categories:
        likelihood = learned_log_variance(p)

    reconstruction = kl_action = kl_observation = 0.0
    for b in range(num_actions):
        kl_action += gaussian_kl(mean[b], log_variance[b], 0.0, 0.0)
        for s in range(num_recordings):
            for step, means in zip(x[b, s, 1:], predicted[b, s], strict=True):
                if num_categories:
                    reconstruction += one_hot_log_likelihood(step, means, num_categories)
                else:
                    reconstruction += gaussian_log_density(step, means, likelihood)
            kl_observation += gaussian_kl(
                z_mean[b, s], z_head["log_variance"], prior_mean[b], prior_head["log_variance"]
            )
    count = num_actions * num_recordings
    return reconstruction / count, kl_action / count, kl_observation / count


def flat_vae(p, x, observation_noise):
    """One training pass of the flat VAE: (reconstruction, kl)."""
    p, x = as_float64(p), np.asarray(x, np.float64)
    h = np.array([[encode_recording(p["encoder"], one) for one in rows] for rows in x])
    head = p["inference"]["LatentHead_0"]
    e = relu(dense(p["inference"]["Dense_0"], h))
    mean = scalar_batch_norm(head["ScalarBatchNorm_0"], latent_mean(head, e))
    z = mean + np.exp(head["log_variance"] / 2) * observation_noise
    reconstruction = kl = 0.0
    for b, s in np.ndindex(*x.shape[:2]):
        g = relu(dense(p["decoder_start"]["from_observation"], z[b, s]))
        predicted = decode(p["decoder"], g, x[b, s, 0], x.shape[2])
        for t in range(1, x.shape[2]):
            reconstruction += gaussian_log_density(
                x[b, s, t], predicted[t - 1], learned_log_variance(p)
            )
        kl += gaussian_kl(mean[b, s], head["log_variance"], 0.0, 0.0)
    count = x.shape[0] * x.shape[1]
    return reconstruction / count, kl / count


def radam(gradients, learning_rate=1e-3, b1=0.9, b2=0.999, eps=1e-8, threshold=5.0):
    """Updates of one scalar for a list of gradients (Liu et al. 2020, algorithm 2)."""
    m = v = 0.0
    updates = []
    rho_inf = 2.0 / (1.0 - b2) - 1.0
    for t, gradient in enumerate(gradients, start=1):
        m = b1 * m + (1 - b1) * gradient
        v = b2 * v + (1 - b2) * gradient**2
        m_hat = m / (1 - b1**t)
        rho = rho_inf - 2 * t * b2**t / (1 - b2**t)
        if rho >= threshold:
            v_hat = np.sqrt(v / (1 - b2**t))
            r = np.sqrt((rho - 4) * (rho - 2) * rho_inf / ((rho_inf - 4) * (rho_inf - 2) * rho))
            updates.append(-learning_rate * r * m_hat / (v_hat + eps))
        else:
            updates.append(-learning_rate * m_hat)
    return updates
