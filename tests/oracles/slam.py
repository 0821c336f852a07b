"""Landmark SLAM as textbooks write it: loops, full matrices and inverses, in float64.

Written from the equations of the specification, in polar coordinates where the package
works along the map's axes, and with joint matrices where it works with blocks.
"""

import math

import numpy as np

LOG_2PI = math.log(2 * math.pi)


def wrap(angle):
    return math.atan2(math.sin(angle), math.cos(angle))


def turn(angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def log_normal(residual, covariance):
    """log N(residual; 0, covariance)."""
    square = residual @ np.linalg.inv(covariance) @ residual
    return -0.5 * (
        square + math.log(np.linalg.det(covariance)) + len(residual) * LOG_2PI
    )


def acfr_rates(speed, steering, L, h, a, b):
    """The utility car of Nieto and Guivant, in the vehicle's frame."""
    vc = speed / (1 - math.tan(steering) * h / L)
    w = vc * math.tan(steering) / L
    return np.array([vc - w * b, w * a, w])


def drive_on(rates, controls):
    """Where controls (v, s, dt) lead from the origin, half a turn before each stretch."""
    x = y = heading = 0.0
    for speed, steering, seconds in controls:
        ahead, left, rate = rates(speed, steering) * seconds
        c, s = math.cos(heading + rate / 2), math.sin(heading + rate / 2)
        x, y, heading = (
            x + c * ahead - s * left,
            y + s * ahead + c * left,
            heading + rate,
        )
    return np.array([x, y, heading])


def drive_noise(rates, controls, sigmas, h=1e-5):
    """Covariance of where controls lead, by central differences of each control."""
    covariance = np.zeros((3, 3))
    for k in range(len(controls)):
        for u in (0, 1):
            there, back = controls.copy(), controls.copy()
            there[k, u] += h
            back[k, u] -= h
            slope = (drive_on(rates, there) - drive_on(rates, back)) / (2 * h)
            covariance += np.outer(slope, slope) * sigmas[u] ** 2
    return covariance


def moved(pose, covariance, move, added):
    """A pose and its covariance after an uncertain motion in its own frame."""
    R = turn(pose[2])
    G = np.eye(3)
    G[:2, :2] = R
    F = np.eye(3)
    F[:2, 2] = R @ np.array([-move[1], move[0]])
    after = np.append(pose[:2] + R @ move[:2], wrap(pose[2] + move[2]))
    return after, F @ covariance @ F.T + G @ added @ G.T


def drawn(mean, covariance, order, normals):
    """A sample of a Gaussian by Cholesky's root, its coordinates taken in an order."""
    order = list(order)
    root = np.linalg.cholesky(covariance[np.ix_(order, order)])
    sample = np.array(mean)
    sample[order] = mean[order] + root @ normals[order]
    return sample


def given_heading(mean, covariance, heading):
    """Position's mean and covariance where the heading is known."""
    gain = covariance[:2, 2] / covariance[2, 2]
    position = mean[:2] + gain * (heading - mean[2])
    return position, covariance[:2, :2] - np.outer(gain, covariance[2, :2])


def sighted(pose, landmark):
    """Range and bearing, with derivatives by the pose and by the landmark."""
    dx, dy = landmark - pose[:2]
    d = math.hypot(dx, dy)
    by_landmark = np.array([[dx / d, dy / d], [-dy / d**2, dx / d**2]])
    by_pose = np.column_stack([-by_landmark, [0.0, -1.0]])
    return np.array([d, wrap(math.atan2(dy, dx) - pose[2])]), by_pose, by_landmark


def innovation(pose, landmark, detection):
    expected = sighted(pose, landmark)[0]
    return np.array([detection[0] - expected[0], wrap(detection[1] - expected[1])])


def started(pose, detection):
    """A landmark's place, with derivatives by the pose and by the detection."""
    r, a = detection[0], pose[2] + detection[1]
    c, s = math.cos(a), math.sin(a)
    by_pose = np.array([[1.0, 0.0, -r * s], [0.0, 1.0, r * c]])
    return pose[:2] + r * np.array([c, s]), by_pose, np.array([[c, -r * s], [s, r * c]])


def displaced(heading, detection, sigmas):
    """z' and its noise: equations (10) and (11)."""
    R = turn(heading + detection[1])
    spread = np.diag([sigmas[0] ** 2, (detection[0] * sigmas[1]) ** 2])
    return R @ np.array([detection[0], 0.0]), R @ spread @ R.T


def fastslam1(pose, landmarks, looks, sigmas):
    """§3: one particle whose pose is drawn already; `landmarks` {id: (m, P)} is changed.

    Returns the log-weight.
    """
    R, weight = np.diag(np.square(sigmas)), 0.0
    for name, z in looks:
        if name in landmarks:
            m, P = landmarks[name]
            H = sighted(pose, m)[2]
            S, v = H @ P @ H.T + R, innovation(pose, m, z)
            weight += log_normal(v, S)
            K = P @ H.T @ np.linalg.inv(S)
            landmarks[name] = m + K @ v, P - K @ S @ K.T
        else:
            m, _, Gz = started(pose, z)
            landmarks[name] = m, Gz @ R @ Gz.T
    return weight


def four_state(position, P, heading, landmarks, looks, sigmas):
    """Equations (9) to (15), one filter of four numbers after the other.

    The position of one is handed to the next; correlations are dropped in between.
    Landmarks are changed in place, the new ones at the end.

    Returns:
        Position, its covariance, log-weight.
    """
    H = np.array([[-1.0, 0, 1, 0], [0, -1, 0, 1]])
    weight, fresh = 0.0, []
    for name, z in looks:
        z, R = displaced(heading, z, sigmas)
        if name not in landmarks:
            fresh.append((name, z, R))
            continue
        m, Pm = landmarks[name]
        mu = np.concatenate([position, m])
        S = np.block([[P, np.zeros((2, 2))], [np.zeros((2, 2)), Pm]])
        y, Z = z - H @ mu, H @ S @ H.T + R
        K = S @ H.T @ np.linalg.inv(Z)
        mu, S = mu + K @ y, (np.eye(4) - K @ H) @ S
        weight += log_normal(y, Z)
        position, P = mu[:2], S[:2, :2]
        landmarks[name] = mu[2:], S[2:, 2:]
    for name, z, R in fresh:
        landmarks[name] = position + z, P + R
    return position, P, weight


def all_at_once(position, P, heading, landmarks, looks, sigmas):
    """As `four_state`, one filter of everything; correlations are dropped at the end."""
    names = list(landmarks)
    mean = np.concatenate([position, *(landmarks[n][0] for n in names)])
    S = np.zeros((len(mean), len(mean)))
    S[:2, :2] = P
    for k, n in enumerate(names):
        S[2 + 2 * k : 4 + 2 * k, 2 + 2 * k : 4 + 2 * k] = landmarks[n][1]
    mean, S, weight, names = dense(mean, S, names, heading, looks, sigmas)
    for k, n in enumerate(names):
        at = slice(2 + 2 * k, 4 + 2 * k)
        landmarks[n] = mean[at], S[at, at]
    return mean[:2], S[:2, :2], weight


def dense(mean, S, names, heading, looks, sigmas):
    """A Kalman filter of [p, all m] for a known heading, all detections in one look."""
    known = [
        (names.index(n), *displaced(heading, z, sigmas)) for n, z in looks if n in names
    ]
    weight = 0.0
    if known:
        H = np.zeros((2 * len(known), len(mean)))
        R = np.zeros((2 * len(known), 2 * len(known)))
        for row, (k, _, noise) in enumerate(known):
            at = slice(2 * row, 2 * row + 2)
            H[at, :2], H[at, 2 + 2 * k : 4 + 2 * k] = -np.eye(2), np.eye(2)
            R[at, at] = noise
        y = np.concatenate([z for _, z, _ in known]) - H @ mean
        Z = H @ S @ H.T + R
        K = S @ H.T @ np.linalg.inv(Z)
        mean, S = mean + K @ y, S - K @ Z @ K.T
        weight = log_normal(y, Z)
    for n, z in looks:
        if n not in names:
            z, R = displaced(heading, z, sigmas)
            G = np.zeros((2, len(mean)))
            G[:, :2] = np.eye(2)
            S = np.block([[S, S @ G.T], [G @ S, G @ S @ G.T + R]])
            mean, names = np.concatenate([mean, mean[:2] + z]), [*names, n]
    return mean, S, weight, names


def ekf(mean, S, names, looks, sigmas):
    """EKF-SLAM of [pose, all m], ranges and bearings one after the other.

    Returns:
        Mean, covariance, names of the landmarks, log-likelihood of the detections.
    """
    R, weight = np.diag(np.square(sigmas)), 0.0
    for n, z in looks:
        if n in names:
            at = 3 + 2 * names.index(n)
            _, by_pose, by_landmark = sighted(mean[:3], mean[at : at + 2])
            H = np.zeros((2, len(mean)))
            H[:, :3], H[:, at : at + 2] = by_pose, by_landmark
            v = innovation(mean[:3], mean[at : at + 2], z)
            Z = H @ S @ H.T + R
            K = S @ H.T @ np.linalg.inv(Z)
            mean, S = mean + K @ v, (np.eye(len(mean)) - K @ H) @ S
            weight += log_normal(v, Z)
        else:
            m, by_pose, by_detection = started(mean[:3], z)
            G = np.zeros((2, len(mean)))
            G[:, :3] = by_pose
            own = G @ S @ G.T + by_detection @ R @ by_detection.T
            S = np.block([[S, S @ G.T], [G @ S, own]])
            mean, names = np.concatenate([mean, m]), [*names, n]
    return mean, S, names, weight


def rsr(weights, offset):
    """Residual systematic resampling, Bolic's loop; the offset lies in [0, 1/N)."""
    N, copies = len(weights), []
    for w in weights:
        copies.append(math.floor((w - offset) * N) + 1)
        offset += copies[-1] / N - w
    return copies


def grid(mean, covariance, reach=5.0, number=31):
    """Points over a Gaussian, `number` along each axis, and their log-densities."""
    line = np.linspace(-reach, reach, number)
    white = np.stack(np.meshgrid(*[line] * len(mean), indexing="ij"), -1)
    white = white.reshape(-1, len(mean))
    cell = (line[1] - line[0]) ** len(mean)
    root = np.linalg.cholesky(covariance)
    log_mass = -0.5 * np.sum(white**2, 1) - len(mean) / 2 * LOG_2PI + math.log(cell)
    return mean + white @ root.T, log_mass
