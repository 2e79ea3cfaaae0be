//! End-to-end tests of Diamantina: one package, one binary.
#![allow(
    clippy::unwrap_used,
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "a test that cannot go on has failed, and its numbers are small"
)]

/// Stores that cannot be read, or not right: what is said, counted, logged, served all the same, and served again.
mod bad_store;
/// The seeds of the fuzzer, for every decoder.
mod corpora;
/// The same input gives the same bytes, whatever the threads and the memory.
mod determinism;
/// What `doctor` says of servers, and of proxies before them.
mod doctor;
/// The papers' tables on real ground.
mod experiments;
/// Answers that are spoilt on their way, servers that end, and scenes that change: the client comes to the same picture.
mod faults;
/// The first view over a slow link: how soon, and never worse while the eye stands still.
mod first_view;
/// Heights asked for: every sample, and places between.
mod heights;
/// Wrong uses, broken files and sudden ends, through the real programs: exit codes, words, what survives.
mod hostile;
/// What the server answers to whom: routes, caches, refusals, heights.
mod http;
/// What was fetched, kept on the disk: the next session, two at once, no server, other versions, private scenes.
mod keep;
/// Law 7, at fifty moments: killed, a build leaves the scene before or a whole new one, for readers and for servers.
mod killed;
/// Several layers in one scene: built, resumed, served, drawn, refused.
mod layers;
/// Who asks too much, too slowly or for nothing does not disturb the others.
mod limits;
/// A slow and distant link, and that it is as slow and distant as asked.
mod link;
/// Many users at once.
mod load;
/// What water shows of the land around, in view or not.
mod mirrors;
/// Progressive streams: what any prefix is worth, who may ask for what, and the client that draws from one.
mod progressive;
/// Law 7: a build that was killed, stopped or ran out of disk goes on; the bytes are those of an unbroken one.
mod resume;
/// A proxy that spoils answers in all ways.
mod rough;
/// Law 2: any cut of a built store, with anything missing, has no cracks.
mod seams;
/// Water that changes with time: built of many files, drawn at a time, and refused.
mod series;
/// What an operator relies on: headers, counters, logs, encryption, tokens, rates, settings.
mod service;
/// Streaming from end to end: pictures, bytes, flights with late data.
mod stream;
/// A scene built again while it is served: nobody is refused, and a bad version never replaces a good one.
mod swap;
mod textures;
/// The house: who may import whom, how long a file may be.
mod tidy;
/// Frames that are timed.
mod timed;
/// Laws 2, 3, 6 and 7 for triangles: borders fit, declared errors hold, killed builds go on, and are served.
mod tin;
/// Triangles as the client draws them: no cracks, no seams of light, the same ground as points.
mod triangles;
/// Law 3: declared errors hold at every sample of real DEMs.
mod truth;
/// The viewer in a window of a virtual screen.
mod window;
/// The harness: synthetic DEM → store → server on a free port → client, and a network that misbehaves.
mod world;
/// Zones: computed, published, served; cheaper pictures from within, and the same skyline.
mod zone;
