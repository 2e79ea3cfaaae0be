//! What is written over pictures, on the command line.

use super::Failure;
use clap::Args;
use diamantina_client::annotate::SIZE_MIN;
use diamantina_client::render::Annotations;

#[derive(Clone, Args)]
pub(super) struct AnnotateArgs {
    /// Write a scale bar, a north arrow and a legend over the picture
    #[arg(long)]
    annotate: bool,
    /// Write a scale bar: it holds across the picture where its middle is, which a cross marks
    #[arg(long)]
    scale_bar: bool,
    /// Write a north arrow: a compass that lies on the level where the middle of the picture is
    #[arg(long)]
    north_arrow: bool,
    /// Write a legend: what the colours of each layer mean, in metres or degrees
    #[arg(long)]
    legend: bool,
}

impl AnnotateArgs {
    /// Whether a picture of this size, in pixels, has room for them.
    pub(super) fn check(&self, [width, height]: [u32; 2]) -> Result<(), Failure> {
        let [least_width, least_height] = SIZE_MIN;
        if self.annotations().is_any() && (width < least_width || height < least_height) {
            return Err(Failure(
                2,
                format!(
                    "--size {width}x{height}: a scale bar, north arrow or legend needs at least {least_width}x{least_height}"
                ),
            ));
        }
        Ok(())
    }

    pub(super) fn annotations(&self) -> Annotations {
        Annotations {
            scale_bar: self.annotate || self.scale_bar,
            north_arrow: self.annotate || self.north_arrow,
            legend: self.annotate || self.legend,
        }
    }
}
