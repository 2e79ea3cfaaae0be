//! Few of many samples, the telling ones likelier: what they say is nearly what all of them would.

/// Priority sampling (Duffield, Lund and Thorup 2007): each sample is given the priority of its importance
/// divided by a number evenly spread over (0, 1]; those of the highest priority are kept, with weights that
/// make their sums right in the mean. In bounded memory, in one turn, and the same at each run.
pub(super) struct Sampler<T> {
    most: usize,
    offered: u64,
    /// Priorities up to this one are out.
    out: f64,
    kept: Vec<Kept<T>>,
}

struct Kept<T> {
    /// Its number among those offered.
    number: u64,
    priority: f64,
    importance: f64,
    sample: T,
}

impl<T> Sampler<T> {
    /// Keeps at most `most`, which is positive.
    pub(super) fn new(most: usize) -> Self {
        Self { most, offered: 0, out: 0.0, kept: Vec::new() }
    }

    /// `importance` is positive; `sample` is called if it may stay.
    pub(super) fn offer(&mut self, importance: f64, sample: impl FnOnce() -> T) {
        self.offered += 1;
        let priority = importance / evenly_spread(self.offered);
        if priority <= self.out {
            return;
        }
        self.kept.push(Kept { number: self.offered, priority, importance, sample: sample() });
        if self.kept.len() == 2 * self.most + 1 {
            self.prune();
        }
    }

    fn prune(&mut self) {
        if self.kept.len() <= self.most {
            return;
        }
        let (_, highest_out, _) =
            self.kept.select_nth_unstable_by(self.most, |a, b| b.priority.total_cmp(&a.priority));
        self.out = highest_out.priority;
        self.kept.truncate(self.most);
    }

    /// Those that stay, in the order in which they came, each with how many it stands for.
    pub(super) fn finish(mut self) -> impl Iterator<Item = (T, f64)> {
        self.prune();
        self.kept.sort_unstable_by_key(|kept| kept.number);
        let out = self.out;
        self.kept.into_iter().map(move |kept| (kept.sample, (out / kept.importance).max(1.0)))
    }
}

/// The numbers 1, 2, 3... hashed to (0, 1] (the finalizer of SplitMix64, Steele, Lea and Flood 2014).
pub(super) fn evenly_spread(number: u64) -> f64 {
    let mut z = number.wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    (((z ^ (z >> 31)) >> 11) + 1) as f64 / (1u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_samples_have_nearly_the_sum_of_all() {
        let values: Vec<f64> = (0..50_000).map(|i| 1.0 + f64::from(i % 97)).collect();
        let mut sampler = Sampler::new(2_000);
        for value in &values {
            sampler.offer(*value, || *value);
        }
        let kept: Vec<(f64, f64)> = sampler.finish().collect();
        assert_eq!(kept.len(), 2_000);
        let sum: f64 = kept.iter().map(|(value, weight)| value * weight).sum();
        let count: f64 = kept.iter().map(|(_, weight)| weight).sum();
        assert!((sum / values.iter().sum::<f64>() - 1.0).abs() < 0.02, "{sum}");
        assert!((count / values.len() as f64 - 1.0).abs() < 0.1, "{count}");
    }

    #[test]
    fn where_there_are_few_all_stay_and_stand_for_themselves() {
        let mut sampler = Sampler::new(10);
        (0..10).for_each(|i| sampler.offer(0.1 + f64::from(i), || i));
        let kept: Vec<(i32, f64)> = sampler.finish().collect();
        assert_eq!(kept, (0..10).map(|i| (i, 1.0)).collect::<Vec<_>>());
    }
}
