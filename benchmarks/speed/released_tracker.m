% The released tracker in Octave: octave --quiet released_tracker.m FOLDER
% FOLDER holds the model and the measurements as text matrices; writes mean.txt and seconds.txt there.
folder = argv(){1};
get = @(name) load(fullfile(folder, [name '.txt']));
weights = get('weights')(:)'; means = get('means')'; H = get('measure'); R = get('noise_z'); z = get('z')';
epsilon = get('epsilon'); [D, K] = size(means); T = columns(z);
cube = @(name) permute(reshape(get(name)', D, D, K), [2 1 3]);
P0 = cube('covariances'); F = cube('matrix'); N = cube('noise'); offset = get('offset')';
seconds = zeros(1, get('runs'));
for run = 1:numel(seconds)
    tic;
    m = means; P = P0; w = weights; estimate = zeros(D, T); logl = zeros(1, K);
    for t = 1:T
        for k = 1:K
            a = F(:, :, k) * m(:, k) + offset(:, k);
            C = F(:, :, k) * P(:, :, k) * F(:, :, k)' + N(:, :, k);
            S = H * C * H' + R;
            e = z(:, t) - H * a;
            G = C * H' / S;
            m(:, k) = a + G * e;
            C = C - G * H * C;
            P(:, :, k) = (C + C') / 2;
            logl(k) = -0.5 * (e' * (S \ e) + log(det(S)) + numel(e) * log(2 * pi));
        end
        w = weights .* w / sum(weights .* w);
        w = w .* exp(logl - max(logl));
        w = w / sum(w);
        estimate(:, t) = m * w';
        w = (w + epsilon) / (1 + K * epsilon);
    end
    seconds(run) = toc;
end
estimate = estimate';
dlmwrite(fullfile(folder, 'mean.txt'), estimate, 'delimiter', ' ', 'precision', 17);
dlmwrite(fullfile(folder, 'seconds.txt'), seconds, 'delimiter', ' ', 'precision', 9);
