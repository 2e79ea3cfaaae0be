//! What is held against the clock, and so has the processors to itself: `make tests` runs these after all others, which
//! are more at a time than there are cores.

use crate::stream::fly_over_magenta;
use crate::world::{Faults, World};
use diamantina_client::encoding::Encoding;
use std::io::Write as _;
use std::time::Duration;

#[test]
fn a_frame_waits_for_nothing_while_the_network_hangs() {
    let world = World::whole(1025);
    let faults = Faults { stalled: 1.0, stall: Duration::from_secs(30), ..Faults::default() };
    let (unfinished, cuts) = fly_over_magenta(&world, faults, 2, Encoding::Points);
    assert!(unfinished > 30, "nothing hung: {unfinished} unfinished frames");
    // Far below the 30 s of the network, far above a cut's own time: a busy machine may pause any thread.
    let (common, slowest) = (cuts[cuts.len() * 95 / 100], cuts[cuts.len() - 1]);
    let _ = writeln!(std::io::stderr(), "cut: 95 % within {common:.1} ms, all within {slowest:.1} ms");
    assert!(common < 250.0 && slowest < 2000.0, "95 % within {common} ms, slowest {slowest} ms");
}
