//! The `tin` encoding: the triangles that are drawn once a diamond is split, as bytes.
//!
//! A patch holds the irregular networks of the (up to) four child triangles of a diamond's square. It needs no
//! other patch to be decoded. Vertices lie on points of the lattice; those on the square's outer border are the
//! same, height and all, in whatever patch lies across it, so there are no cracks. Where there are no
//! triangles there are no data.
//!
//! A payload tells the mesh in the order of a walk over it that both ends take (`walk`): of each edge what lies
//! beyond, and of each new vertex how far it is from where the triangle behind the edge lets it expect. So no
//! index is ever sent, and most of what is sent is small. Of a whole lattice (`lattice`: every point of the square, each
//! cell cut along the diagonal of the bintree) heights alone are sent, row by row (`rows`).
//!
//! | offset | size | field | valid range |
//! |---|---|---|---|
//! | 0 | 1 | format, in the high four bits | 2 |
//! | 0 | | bit 0: some border lies inside of the square; bit 1: two lanes, just where there are as many triangles as [`TWO_LANES_TRIANGLES`]; bit 2: a whole lattice, which has no such border | |
//! | 1 | .. | symbols, see [`crate::rans`] | |
//!
//! The symbols are: base-2 logarithm of the unit of x and y (5 plain bits); the first vertex's height; one less than
//! the unit of heights, which is the largest that divides all differences; the walk, or the lattice's rows. Each bit of the
//! walk has an adaptive context, and goes in the first lane; all numbers go in the last, but those of a row, which take
//! turns. A payload without bytes is a patch without triangles.
//!
//! Every payload that decodes encodes to the same bytes again: nothing can be said in two ways.
//!
//! History: format 1 told whole lattices by walks, too.

mod lattice;
mod mesh;
mod numbers;
mod place;
mod regular;
mod rows;
mod walk;

use crate::HEIGHT_MAX;
use crate::bintree::Forest;
use crate::diamond::Diamond;
use crate::rans::{Context, Decoder, Encoder};
use lattice::Lattice;
pub use lattice::Lattices;
use mesh::Mesh;
use numbers::{Class, Scale, Tables};
use place::{Point, Square};
use walk::{Beyond, Fault, Pass, Seed, Walk, Wire, index};

/// The format that this build writes, and the only one that it reads.
pub const FORMAT: u8 = 2;

/// The most triangles of a patch: a full grid of the largest patches' cells.
pub const TRIANGLES_MAX: usize = 1 << 16;

/// The most vertices of a patch: indices of 16 bits, but for the one that restarts strips.
pub const VERTICES_MAX: usize = (1 << 16) - 1;

/// Payloads of this many triangles and more have two lanes: a second one costs three bytes.
pub const TWO_LANES_TRIANGLES: usize = 512;

const HOLES: u8 = 1;
const TWO_LANES: u8 = 2;
const LATTICE: u8 = 4;

/// A vertex of a patch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Vertex {
    /// Lattice coordinate, to the east.
    pub x: u32,
    /// Lattice coordinate, to the north.
    pub y: u32,
    /// Height, in quanta.
    pub height: i32,
}

/// What is drawn once a diamond is split.
///
/// Takes 12 bytes a vertex and 12 a triangle: 1.6 MB at most.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Patch {
    /// The vertices; those on the diagonals belong to more than one child triangle.
    pub vertices: Vec<Vertex>,
    /// Triangles as indices of vertices, turning left in plan: first those of child triangle 0, and so on.
    pub triangles: Vec<[u32; 3]>,
    /// For each child triangle, where its triangles end. Child triangle q has side q of the diamond's local grid
    /// as its hypotenuse, and the diamond's centre as its apex.
    pub ends: [u32; 4],
}

impl Patch {
    /// The triangles of a child triangle, as positions in [`Patch::triangles`].
    #[must_use]
    pub fn range(&self, child: usize) -> std::ops::Range<usize> {
        let from = if child == 0 { 0 } else { self.ends[child - 1] };
        from as usize..self.ends[child] as usize
    }
}

/// Why a patch cannot be encoded. Each is a mistake of whoever made it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PatchError {
    /// Too many triangles.
    #[error("patch of {0} triangles, limit {TRIANGLES_MAX}: simplify further, or take a smaller patch")]
    Triangles(usize),
    /// Too many vertices.
    #[error("patch of more than {VERTICES_MAX} vertices: simplify further, or take a smaller patch")]
    Vertices,
    /// Ranges that are none.
    #[error("patch's triangles end at {0:?}, expected rising numbers up to their count")]
    Ends([u32; 4]),
    /// A triangle of a vertex that is not there.
    #[error("triangle {0:?} of a vertex that the patch has not")]
    Vertex([u32; 3]),
    /// A triangle that turns right, or has no area.
    #[error("triangle {0:?} does not turn left")]
    Turn([u32; 3]),
    /// A triangle outside of its child triangle.
    #[error("triangle {0:?} is not within child triangle {1}")]
    Child([u32; 3], usize),
    /// Two triangles on the same side of an edge, or overlapping ones.
    #[error("triangles overlap at the edge from vertex {0} to {1}")]
    Edge(u32, u32),
    /// Triangles that overlap somewhere.
    #[error("triangles overlap")]
    Overlap,
    /// A height beyond the range of heights.
    #[error("height of {0} quanta, expected at most {HEIGHT_MAX}")]
    Height(i32),
}

/// Why bytes are not the payload of a diamond. Whichever it is, drop them and ask again.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// Written by another version.
    #[error("patch has format {found}, this build reads {FORMAT}: rebuild the store")]
    Format {
        /// The format found.
        found: u8,
    },
    /// Unknown flags.
    #[error("patch has flags {found:#x}, which no encoder sets: fetch it again")]
    Flags {
        /// The flags found.
        found: u8,
    },
    /// Cut off, with something behind, or not written by an encoder.
    #[error("patch's symbols are damaged: fetch it again")]
    Symbols,
    /// A vertex outside of the diamond, or a triangle that overlaps another.
    #[error("patch has a vertex or a triangle out of its place: fetch it again")]
    Place,
    /// More triangles or vertices than a patch may have.
    #[error("patch of more than {TRIANGLES_MAX} triangles or {VERTICES_MAX} vertices: fetch it again")]
    Size,
    /// A height beyond the range of heights.
    #[error("patch has a height beyond {HEIGHT_MAX} quanta: fetch it again")]
    Height,
}

impl From<Fault> for DecodeError {
    fn from(fault: Fault) -> Self {
        match fault {
            Fault::Symbols => Self::Symbols,
            Fault::Place => Self::Place,
            Fault::Size => Self::Size,
        }
    }
}

/// What comes before the walk.
#[derive(Debug, Clone, Copy)]
struct Units {
    /// Base-2 logarithm of the unit of x and y.
    shift: u32,
    /// The first vertex's height, in quanta.
    base: i64,
    /// The unit of heights, in quanta.
    step: i64,
}

impl Units {
    /// Sends or receives them.
    fn pass(self, pass: &mut impl Wire) -> Result<Self, Fault> {
        let shift = pass.plain(self.shift, 5);
        let base = pass.number(&mut Scale::expecting(1024), self.base)?;
        let step = 1 + pass.number(&mut Scale::expecting(1), self.step - 1)?;
        Ok(Self { shift, base, step })
    }

    /// The height of a vertex, told in units from the first one's.
    #[inline]
    fn height(&self, vertex: usize, told: i32) -> Result<i32, DecodeError> {
        let height = self.base + self.step * i64::from(told);
        if (vertex == 0 && told != 0) || height.abs() > i64::from(HEIGHT_MAX) {
            return Err(DecodeError::Height);
        }
        i32::try_from(height).map_err(|_| DecodeError::Height)
    }

    /// Whether the unit of heights is as large as can be, given what divides all heights told in it.
    fn is_largest(&self, divisor: i64) -> bool {
        divisor == 1 || (divisor == 0 && self.step == 1)
    }
}

/// The bytes of a patch. They depend on the patch alone: on the order of its triangles, but not on that of its vertices.
///
/// What comes back has the same triangles in another order, each child triangle's together, in an order that caches
/// like; vertices in the order in which triangles use them (of a whole lattice row by row), without those that none does; and
/// one vertex for each fan of triangles where fans meet in a point alone.
///
/// # Errors
/// When it is no patch of this diamond.
pub fn encode(forest: &Forest, d: Diamond, patch: &Patch) -> Result<Vec<u8>, PatchError> {
    match lattice::of(forest, d, patch) {
        Some((lattice, heights)) => encode_lattice(&lattice, heights),
        None => encode_mesh(forest, d, patch, &Neighbours::of(&patch.triangles, patch.vertices.len())),
    }
}

/// Which triangles of a patch have an edge in common. Takes 16 bytes a triangle.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Neighbours {
    across: Vec<u32>,
    /// An edge with two triangles on the same side.
    repeated: Option<[u32; 2]>,
}

impl Neighbours {
    /// Those of triangles of so many vertices. Of what is no patch the outcome has no meaning but to [`encode_with`], which
    /// refuses it.
    #[must_use]
    pub fn of(triangles: &[[u32; 3]], vertices: usize) -> Self {
        let (across, repeated) = mesh::across(triangles, vertices);
        Self { across, repeated }
    }

    /// Across the edge of triangle t from its corner i to the next one, at 4 t + i: four times the number of the triangle
    /// there and the corner at which the same edge begins in it; `u32::MAX` if there is none. Every fourth is that.
    #[must_use]
    pub fn across(&self) -> &[u32] {
        &self.across
    }
}

/// [`encode`] given the patch's own neighbours.
///
/// # Errors
/// When it is no patch of this diamond.
///
/// # Panics
/// If the neighbours are those of a patch with fewer triangles.
pub fn encode_with(
    forest: &Forest,
    d: Diamond,
    patch: &Patch,
    neighbours: &Neighbours,
) -> Result<Vec<u8>, PatchError> {
    match lattice::of(forest, d, patch) {
        Some((lattice, heights)) => encode_lattice(&lattice, heights),
        None => encode_mesh(forest, d, patch, neighbours),
    }
}

/// [`encode`] of what [`Lattices`] has made: its triangles are not looked at.
///
/// # Errors
/// When a height is beyond the range of heights.
pub fn encode_whole(forest: &Forest, d: Diamond, patch: &Patch) -> Result<Vec<u8>, PatchError> {
    match Lattice::new(forest, d, 0) {
        Some(lattice) if lattice.points() == patch.vertices.len() => {
            encode_lattice(&lattice, patch.vertices.iter().map(|v| v.height).collect())
        }
        _ => encode(forest, d, patch),
    }
}

/// A whole lattice, given its heights row by row.
fn encode_lattice(lattice: &Lattice, mut heights: Vec<i32>) -> Result<Vec<u8>, PatchError> {
    if let Some(height) = heights.iter().find(|h| h.unsigned_abs() > HEIGHT_MAX.unsigned_abs()) {
        return Err(PatchError::Height(*height));
    }
    let first = heights.first().copied().unwrap_or(0);
    heights.iter_mut().for_each(|height| *height -= first);
    let step = divisor(&heights).max(1);
    if step > 1 {
        heights.iter_mut().for_each(|height| *height /= step);
    }
    let lanes = lanes(lattice.triangles());
    // A table's symbol, and often the bits below it.
    let coder = Encoder::with_capacity(2 * heights.len() + 16);
    let mut sender = Sender { coder, tables: numbers::tables(), mesh: () };
    let units = Units { shift: lattice.shift(), base: first.into(), step: step.into() };
    let passed = units.pass(&mut sender).and_then(|_| rows::pass(lattice.rows(), &mut heights, &mut sender));
    // Heights are in range, so this end finds no fault.
    passed.map_err(|_| PatchError::Overlap)?;
    Ok(with_header(LATTICE, sender.coder, lanes))
}

/// The bytes behind their header.
fn with_header(flags: u8, coder: Encoder, lanes: usize) -> Vec<u8> {
    let mut bytes = coder.finish(lanes);
    bytes.insert(0, FORMAT << 4 | flags | if lanes == 2 { TWO_LANES } else { 0 });
    bytes
}

/// How many lanes the payload of so many triangles has.
fn lanes(triangles: usize) -> usize {
    if triangles >= TWO_LANES_TRIANGLES { 2 } else { 1 }
}

/// The largest number that divides all heights; 0 if none is anything else.
fn divisor(heights: &[i32]) -> i32 {
    let mut divisor = 0;
    for height in heights {
        divisor = gcd(divisor, i64::from(*height));
        // Nothing divides it further.
        if divisor == 1 {
            break;
        }
    }
    i32::try_from(divisor).unwrap_or(1)
}

/// [`encode_with`] of what is no whole lattice.
fn encode_mesh(
    forest: &Forest,
    d: Diamond,
    patch: &Patch,
    neighbours: &Neighbours,
) -> Result<Vec<u8>, PatchError> {
    let Some(first) = patch.triangles.first().and_then(|t| patch.vertices.get(t[0] as usize)) else {
        return if patch.triangles.is_empty() {
            Ok(Vec::new())
        } else {
            Err(PatchError::Vertex(patch.triangles[0]))
        };
    };
    let mut is_used = vec![false; patch.vertices.len()];
    for v in patch.triangles.as_flattened() {
        if let Some(is_used) = is_used.get_mut(*v as usize) {
            *is_used = true;
        }
    }
    let centre = d.centre();
    let base = i64::from(first.height);
    let (mut all, mut step) = (0, 0);
    for (v, _) in patch.vertices.iter().zip(&is_used).filter(|(_, is_used)| **is_used) {
        if v.height.unsigned_abs() > HEIGHT_MAX.unsigned_abs() {
            return Err(PatchError::Height(v.height));
        }
        all |= (v.x ^ centre[0]) | (v.y ^ centre[1]);
        // Nothing divides it further.
        if step != 1 {
            step = gcd(step, i64::from(v.height) - base);
        }
    }
    let step = step.max(1);
    let units = Units { shift: all.trailing_zeros().min(31), base, step };
    // Vertices that no triangle uses may lie anywhere, and then they are not told.
    let narrow = |value: i64| i32::try_from(value).unwrap_or(i32::MAX);
    let point = |v: &Vertex| {
        let height = i64::from(v.height) - base;
        Point {
            x: narrow((i64::from(v.x) - i64::from(centre[0])) >> units.shift),
            y: narrow((i64::from(v.y) - i64::from(centre[1])) >> units.shift),
            height: narrow(if step == 1 { height } else { height / step }),
        }
    };
    let points: Vec<Point> = patch.vertices.iter().map(point).collect();
    let square = Square::new(forest, d, units.shift);
    let mesh = Mesh::new(patch, neighbours, &points, &square)?;
    let holes = mesh.has_holes();
    let expected = patch.triangles.len();
    // Two bits or three a triangle, and three numbers a vertex.
    let coder = Encoder::with_capacity(5 * expected);
    let mut sender = Sender { coder, tables: numbers::tables(), mesh };
    let passed = units.pass(&mut sender).and_then(|_| Walk::new(square, holes, expected).run(&mut sender));
    passed.map_err(|fault| if fault == Fault::Size { PatchError::Vertices } else { PatchError::Overlap })?;
    Ok(with_header(if holes { HOLES } else { 0 }, sender.coder, lanes(expected)))
}

/// The patch of a diamond. The bytes may be hostile: whatever is returned has no more than [`TRIANGLES_MAX`]
/// triangles, each turning left within its child triangle, no two on the same side of an edge, and heights in range.
///
/// Takes 14 MB beside the patch at most, most of it for gates (28 bytes each, two a triangle and two a part, and what a list
/// takes that has just grown), and time in proportion to the triangles.
///
/// # Errors
/// When the bytes are no payload of this format.
pub fn decode(forest: &Forest, d: Diamond, bytes: &[u8]) -> Result<Patch, DecodeError> {
    let Some((header, symbols)) = bytes.split_first() else { return Ok(Patch::default()) };
    let (format, flags) = (header >> 4, header & 15);
    if format != FORMAT {
        return Err(DecodeError::Format { found: format });
    }
    if flags > LATTICE | TWO_LANES || flags & (LATTICE | HOLES) == LATTICE | HOLES {
        return Err(DecodeError::Flags { found: flags });
    }
    let coder =
        Decoder::new(symbols, if flags & TWO_LANES == 0 { 1 } else { 2 }).ok_or(DecodeError::Symbols)?;
    let patch = if coder.lanes() == 1 {
        receive(forest, d, Receiver::<0> { coder, tables: numbers::tables() }, flags, bytes.len())
    } else {
        receive(forest, d, Receiver::<1> { coder, tables: numbers::tables() }, flags, bytes.len())
    }?;
    let has_its_lanes = lanes(patch.triangles.len()) == coder.lanes();
    // A whole lattice is told as one.
    let is_told_well = flags & LATTICE != 0 || lattice::of(forest, d, &patch).is_none();
    if has_its_lanes && is_told_well { Ok(patch) } else { Err(DecodeError::Symbols) }
}

/// A whole lattice.
fn receive_lattice<const LANE: usize>(
    forest: &Forest,
    d: Diamond,
    units: Units,
    mut receiver: Receiver<'_, LANE>,
) -> Result<Patch, DecodeError> {
    let lattice = Lattice::new(forest, d, units.shift).ok_or(DecodeError::Symbols)?;
    let mut heights = vec![0; lattice.points()];
    rows::pass(lattice.rows(), &mut heights, &mut receiver)?;
    let divisor = i64::from(divisor(&heights));
    if !receiver.coder.is_spent() || !units.is_largest(divisor) {
        return Err(DecodeError::Symbols);
    }
    for (i, height) in heights.iter_mut().enumerate() {
        *height = units.height(i, *height)?;
    }
    Ok(lattice.patch(&heights))
}

/// The patch that comes in; numbers are in the lane.
fn receive<const LANE: usize>(
    forest: &Forest,
    d: Diamond,
    mut receiver: Receiver<'_, LANE>,
    flags: u8,
    bytes: usize,
) -> Result<Patch, DecodeError> {
    let units = Units { shift: 0, base: 0, step: 1 }.pass(&mut receiver)?;
    if units.step < 1 {
        return Err(DecodeError::Symbols);
    }
    if flags & LATTICE != 0 {
        return receive_lattice(forest, d, units, receiver);
    }
    let square = Square::new(forest, d, units.shift);
    if square.is_empty() {
        return Err(DecodeError::Symbols);
    }
    // More are found at less than four bits each.
    let mut walk = Walk::new(square, flags & HOLES != 0, 2 * bytes);
    walk.run(&mut receiver)?;
    if receiver.coder.is_spent() { gather(&walk, units, d) } else { Err(DecodeError::Symbols) }
}

/// The patch that a walk has found, if its units are as large as can be.
fn gather(walk: &Walk, units: Units, d: Diamond) -> Result<Patch, DecodeError> {
    let centre = d.centre().map(i64::from);
    let mut vertices = Vec::with_capacity(walk.points().len());
    let (mut odd, mut divisor) = (0, 0);
    for (i, point) in walk.points().enumerate() {
        odd |= point.x | point.y;
        if divisor != 1 {
            divisor = gcd(divisor, i64::from(point.height));
        }
        let place = |middle: i64, away: i32| {
            u32::try_from(middle + (i64::from(away) << units.shift)).map_err(|_| DecodeError::Place)
        };
        vertices.push(Vertex {
            x: place(centre[0], point.x)?,
            y: place(centre[1], point.y)?,
            height: units.height(i, point.height)?,
        });
    }
    if odd & 1 == 0 || !units.is_largest(divisor) {
        return Err(DecodeError::Symbols);
    }
    let mut ends = walk.triangles().each_ref().map(|of_child| index(of_child.len()));
    for child in 1..4 {
        ends[child] += ends[child - 1];
    }
    let triangles = walk.triangles().concat();
    Ok(Patch { vertices, triangles, ends })
}

fn gcd(a: i64, b: i64) -> i64 {
    let (mut a, mut b) = (a.abs(), b.abs());
    while b != 0 {
        (a, b) = (b, a % b);
    }
    a
}

/// With the mesh that a walk goes over.
struct Sender<M> {
    coder: Encoder,
    tables: &'static Tables,
    mesh: M,
}

/// Of numbers in the lane; bits are in the first.
struct Receiver<'a, const LANE: usize> {
    coder: Decoder<'a>,
    tables: &'static Tables,
}

impl<M> Wire for Sender<M> {
    #[inline]
    fn number(&mut self, scale: &mut Scale, number: i64) -> Result<i64, Fault> {
        numbers::encode(&mut self.coder, 1, self.tables, scale, number);
        Ok(number)
    }
    fn plain(&mut self, value: u32, bits: u32) -> u32 {
        numbers::plain(&mut self.coder, 1, value, bits);
        value
    }
}

impl Pass for Sender<Mesh<'_>> {
    #[inline]
    fn bit(&mut self, context: &mut Context, bit: bool) -> bool {
        self.coder.bit(context, bit);
        bit
    }
    fn seed(&mut self) -> Option<Seed> {
        self.mesh.seed()
    }
    #[inline]
    fn beyond(&mut self, mark: u32) -> Beyond {
        self.mesh.beyond(mark)
    }
    #[inline]
    fn marks(&self, mark: u32) -> [u32; 2] {
        self.mesh.marks(mark)
    }
}

impl rows::End for Sender<()> {
    const SENDS: bool = true;
    #[inline]
    fn row(&mut self, classes: &[Class], numbers: &mut [i32]) -> Result<(), Fault> {
        for (i, (class, number)) in classes.iter().zip(numbers).enumerate() {
            let lane = if i & 1 == 0 { 0 } else { 1 };
            numbers::encode_as(&mut self.coder, lane, self.tables, *class, i64::from(*number));
        }
        Ok(())
    }
}

impl<const LANE: usize> Wire for Receiver<'_, LANE> {
    #[inline(always)]
    fn number(&mut self, scale: &mut Scale, _: i64) -> Result<i64, Fault> {
        numbers::decode::<LANE>(&mut self.coder, self.tables, scale).ok_or(Fault::Symbols)
    }
    fn plain(&mut self, _: u32, bits: u32) -> u32 {
        numbers::read_plain::<LANE>(&mut self.coder, bits)
    }
}

impl<const LANE: usize> Receiver<'_, LANE> {
    /// The next number in one of the lanes.
    #[inline(always)]
    fn next<const ITS: usize>(&mut self, class: Class) -> Result<i32, Fault> {
        let number = numbers::decode_as::<ITS>(&mut self.coder, self.tables, class);
        number.and_then(|number| i32::try_from(number).ok()).ok_or(Fault::Symbols)
    }
}

impl<const LANE: usize> rows::End for Receiver<'_, LANE> {
    const SENDS: bool = false;
    #[inline]
    fn row(&mut self, classes: &[Class], numbers: &mut [i32]) -> Result<(), Fault> {
        let (numbers, last) = numbers.as_chunks_mut::<2>();
        let (classes, last_class) = classes.as_chunks::<2>();
        for (pair, class) in numbers.iter_mut().zip(classes) {
            *pair = [self.next::<0>(class[0])?, self.next::<LANE>(class[1])?];
        }
        for (number, class) in last.iter_mut().zip(last_class) {
            *number = self.next::<0>(*class)?;
        }
        Ok(())
    }
}

impl<const LANE: usize> Pass for Receiver<'_, LANE> {
    #[inline(always)]
    fn bit(&mut self, context: &mut Context, _: bool) -> bool {
        self.coder.bit(context)
    }
    fn seed(&mut self) -> Option<Seed> {
        None
    }
    #[inline(always)]
    fn beyond(&mut self, _: u32) -> Beyond {
        Beyond::Nothing
    }
    #[inline(always)]
    fn marks(&self, _: u32) -> [u32; 2] {
        [0; 2]
    }
}

#[cfg(test)]
#[allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_sign_loss,
    reason = "small numbers"
)]
mod tests;
