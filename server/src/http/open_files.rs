//! The limit on open files, of which each connection takes one.

use super::limits::Limits;

/// Files that are open besides connections and packs: sockets to object stores, the log, files that are looked at.
const OTHERS: u64 = 128;

/// Files that each thread which serves or works for those has open.
const OF_THREAD: u64 = 8;

pub(super) use system::raise;

/// Lowers the limit on connections to what fits where so many files may be open, some of them packs: at the limit the system
/// refuses to accept, and who comes then waits without a word.
pub(super) fn fit(limits: Limits, files: u64, packs: u64) -> Limits {
    let threads = std::thread::available_parallelism().map_or(1, |count| count.get() as u64);
    let most = connections(files, packs, threads);
    if most >= u64::from(limits.max_connections) {
        return limits;
    }
    let max_connections = u32::try_from(most).unwrap_or(u32::MAX);
    tracing::warn!(
        open_files = files,
        packs,
        max_connections,
        asked = limits.max_connections,
        "fewer connections than asked, since so few files may be open: raise that (`ulimit -Hn`, LimitNOFILE=)"
    );
    Limits { max_connections, ..limits }
}

/// Connections that fit where so many files may be open. Where a scene is replaced the packs of both versions are open. If little
/// is left, half of that.
fn connections(files: u64, packs: u64, threads: u64) -> u64 {
    let comfortable = files.saturating_sub(OTHERS + OF_THREAD * threads + 2 * packs);
    comfortable.max(files.saturating_sub(packs) / 2).max(1)
}

#[cfg(target_os = "linux")]
mod system {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

    /// Raises the limit of this process as high as it may be, and tells it, if there is one.
    pub(in crate::http) fn raise() -> Option<u64> {
        let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
        match setrlimit(Resource::Nofile, Rlimit { current: maximum, maximum }) {
            Ok(()) => maximum,
            Err(error) => {
                tracing::debug!(%error, "the limit on open files stays");
                current
            }
        }
    }
}

#[cfg(not(target_os = "linux"))]
mod system {
    pub(in crate::http) fn raise() -> Option<u64> {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packs_leave_room_for_connections_and_the_other_way_round() {
        assert_eq!(connections(1 << 20, 0, 2), (1 << 20) - 144);
        assert_eq!(connections(1024, 100, 2), 1024 - 200 - 144);
        assert_eq!(connections(128, 60, 2), 34);
        assert_eq!(connections(64, 1000, 2), 1);
    }
}
