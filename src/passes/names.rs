//! The one table of what renderers call their passes, and how each is told to write them.
//!
//! Blender 5 writes `Diffuse Color`, Blender 4 and older `DiffCol`; other renderers have names of their own,
//! which were looked up where each table says. How a channel is named beyond its pass is `channels`'
//! business.

use std::{collections::HashSet, fmt, sync::LazyLock};

use super::{Pass, Quantity};

/// Shader AOV in which the export script stores the world position averaged over samples.
pub const POSITION_AOV: &str = "DEMC Position";
/// Pass that Blender adds when it denoises the render itself: the render before that.
pub const NOISY_IMAGE: &str = "Noisy Image";

/// The renderer's image.
pub const COMBINED: &str = "Combined";
/// What the names of light groups begin with (Cycles' `engine.py`); the group's own name follows.
const LIGHT_GROUP: &str = "Combined_";

/// The light group whose pass has that name.
pub fn light_group(pass: &str) -> Option<&str> {
    pass.strip_prefix(LIGHT_GROUP).filter(|group| !group.is_empty() && !group.contains('.'))
}

/// How the components of a pass are named; alternatives are tried in order.
pub type Components = &'static [&'static [&'static str]];

/// How renderers name the components of a pass: see [`super::channels::is_component`] for how they are
/// compared.
pub fn components(pass: Pass) -> Components {
    match pass.quantity() {
        Quantity::Direction | Quantity::Place => &[&["X", "Y", "Z"], &["R", "G", "B"]],
        Quantity::Motion => &[&["X", "Y", "Z", "W"], &["R", "G", "B", "A"]],
        // `V` in Blender's File Output node, `T` in Mitsuba, nothing where the channel is the pass.
        Quantity::Distance => &[&["Z"], &["V"], &["T"], &["X"], &["Y"], &["R"], &[""]],
        Quantity::Share => &[&["A"], &[""]],
        // Luminance and chroma where there are no colours: see [`crate::frame::to_rgb`].
        Quantity::Radiance | Quantity::Colour => &[&["R", "G", "B"], &["Y", "RY", "BY"]],
    }
}

/// One row: a pass, a renderer's names for it (the one to prefer first) and how it is turned on.
pub struct PassNames {
    /// The meaning.
    pub pass: Pass,
    /// The renderer's names. Letter case, spaces and underscores do not matter where no name is the very
    /// same.
    pub names: &'static [&'static str],
    /// How the renderer is told to write it, as a sentence part.
    pub setting: &'static str,
}

/// A renderer, and what it calls its passes.
pub struct Renderer {
    /// Its name in messages.
    pub name: &'static str,
    /// The passes that it writes and demc knows.
    pub rows: &'static [PassNames],
    /// What it calls its motion, which demc does not follow: units and directions differ from Cycles'.
    pub motion: &'static [&'static str],
}

impl fmt::Debug for Renderer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name)
    }
}

macro_rules! row {
    ($pass:ident, $names:expr, $setting:expr) => {
        PassNames { pass: Pass::$pass, names: &$names, setting: $setting }
    };
}

macro_rules! blender {
    ($pass:ident, $names:expr, $setting:literal) => {
        row!($pass, $names, concat!("turn on View Layer Properties > Passes > ", $setting))
    };
}

/// Blender, whose names are those of [`Pass`] too. `Image` is what its File Output node calls the beauty.
/// Names: Cycles' `engine.py`.
pub static BLENDER: Renderer = Renderer {
    name: "Blender",
    motion: &[],
    rows: &[
        blender!(Combined, [COMBINED, "Image"], "Data > Combined"),
        blender!(
            Alpha,
            [COMBINED, "Image"],
            "Data > Combined and set Output Properties > Output > Color to RGBA"
        ),
        blender!(
            NoisyImage,
            [NOISY_IMAGE],
            "Data > Denoising Data and keep Render Properties > Sampling > Render > Denoise on"
        ),
        blender!(Depth, ["Depth"], "Data > Z"),
        blender!(Position, [POSITION_AOV, "Position"], "Data > Position"),
        blender!(Normal, ["Normal"], "Data > Normal"),
        blender!(Vector, ["Vector"], "Data > Vector"),
        blender!(DiffuseDirect, ["Diffuse Direct", "DiffDir"], "Light > Diffuse > Direct"),
        blender!(DiffuseIndirect, ["Diffuse Indirect", "DiffInd"], "Light > Diffuse > Indirect"),
        blender!(DiffuseColor, ["Diffuse Color", "DiffCol"], "Light > Diffuse > Color"),
        blender!(GlossyDirect, ["Glossy Direct", "GlossDir"], "Light > Glossy > Direct"),
        blender!(GlossyIndirect, ["Glossy Indirect", "GlossInd"], "Light > Glossy > Indirect"),
        blender!(GlossyColor, ["Glossy Color", "GlossCol"], "Light > Glossy > Color"),
        blender!(TransmissionDirect, ["Transmission Direct", "TransDir"], "Light > Transmission > Direct"),
        blender!(
            TransmissionIndirect,
            ["Transmission Indirect", "TransInd"],
            "Light > Transmission > Indirect"
        ),
        blender!(TransmissionColor, ["Transmission Color", "TransCol"], "Light > Transmission > Color"),
        blender!(VolumeDirect, ["Volume Direct", "VolumeDir"], "Light > Volume > Direct"),
        blender!(VolumeIndirect, ["Volume Indirect", "VolumeInd"], "Light > Volume > Indirect"),
        blender!(Emission, ["Emission", "Emit"], "Light > Emission"),
        blender!(Environment, ["Environment", "Env"], "Light > Environment"),
        blender!(ShadowCatcher, ["Shadow Catcher"], "Light > Shadow Catcher"),
        blender!(AmbientOcclusion, ["Ambient Occlusion", "AO"], "Light > Ambient Occlusion"),
        blender!(DenoisingNormal, ["Denoising Normal"], "Data > Denoising Data"),
        blender!(DenoisingAlbedo, ["Denoising Albedo"], "Data > Denoising Data"),
        blender!(DenoisingDepth, ["Denoising Depth"], "Data > Denoising Data"),
    ],
};

/// Arnold. Names: its user guide, "AOVs", and `kick -laovs`; the normal and the position are in world space.
static ARNOLD: Renderer = Renderer {
    name: "Arnold",
    motion: &["motionvector"],
    rows: &[
        row!(Combined, ["RGBA"], "render the beauty AOV RGBA"),
        row!(Alpha, ["RGBA"], "render the beauty AOV RGBA"),
        row!(
            DenoisingAlbedo,
            ["denoise_albedo", "albedo", "diffuse_albedo"],
            "add denoise_albedo in Render Settings > AOVs"
        ),
        row!(DenoisingNormal, ["N", "N_denoise"], "add N in Render Settings > AOVs"),
        row!(Normal, ["N"], "add N in Render Settings > AOVs"),
        row!(Position, ["P"], "add P in Render Settings > AOVs"),
        row!(DiffuseColor, ["diffuse_albedo"], "add diffuse_albedo in Render Settings > AOVs"),
        row!(GlossyColor, ["specular_albedo"], "add specular_albedo in Render Settings > AOVs"),
        row!(TransmissionColor, ["transmission_albedo"], "add transmission_albedo in Render Settings > AOVs"),
        row!(Depth, ["Z"], "add Z in Render Settings > AOVs"),
    ],
};

/// V-Ray for 3ds Max, and for other programs where it names render elements alike. Names: Chaos'
/// documentation, "Render Elements".
static VRAY: Renderer = Renderer {
    name: "V-Ray",
    motion: &["VRayVelocity"],
    rows: &[
        row!(
            DenoisingAlbedo,
            ["VRayDiffuseFilter"],
            "add VRayDiffuseFilter in Render Setup > Render Elements"
        ),
        row!(
            DenoisingNormal,
            ["VRayBumpNormals", "VRayNormals"],
            "add VRayBumpNormals in Render Setup > Render Elements"
        ),
        row!(Depth, ["VRayZDepth"], "add VRayZDepth in Render Setup > Render Elements"),
    ],
};

/// V-Ray for Maya and Modo. Names: Chaos' documentation, "Render Elements", "Default Channel Names".
static VRAY_MAYA: Renderer = Renderer {
    name: "V-Ray",
    motion: &["velocity"],
    rows: &[
        row!(DenoisingAlbedo, ["diffuse"], "add Diffuse in Render Settings > Render Elements"),
        row!(
            DenoisingNormal,
            ["bumpNormals", "normals"],
            "add Bump Normals in Render Settings > Render Elements"
        ),
        row!(Depth, ["depth", "zDepth"], "add Z-depth in Render Settings > Render Elements"),
    ],
};

/// RenderMan. Names: Pixar's documentation, "Denoising", "Required Channels".
static RENDERMAN: Renderer = Renderer {
    name: "RenderMan",
    motion: &["forward", "backward"],
    rows: &[
        row!(Combined, ["Ci"], "write the display channel Ci"),
        row!(
            DenoisingAlbedo,
            ["albedo"],
            "write the display channel albedo, as for RenderMan's own denoiser"
        ),
        row!(
            DenoisingNormal,
            ["normal", "Nn"],
            "write the display channel normal, as for RenderMan's own denoiser"
        ),
        row!(Depth, ["zfiltered", "z"], "write the display channel zfiltered"),
    ],
};

/// Redshift. Names: Maxon's documentation, "Integrated AOVs".
static REDSHIFT: Renderer = Renderer {
    name: "Redshift",
    motion: &["MotionVectors"],
    rows: &[
        row!(DenoisingAlbedo, ["DiffuseFilter"], "add Diffuse Filter in the AOV Manager"),
        row!(DenoisingNormal, ["BumpNormals", "Normals"], "add Bump Normals in the AOV Manager"),
        row!(Position, ["WorldPosition"], "add World Position in the AOV Manager"),
        row!(Depth, ["Depth"], "add Depth in the AOV Manager"),
    ],
};

/// Karma. Names: SideFX's documentation, "Karma Render Settings", image output.
static KARMA: Renderer = Renderer {
    name: "Karma",
    motion: &["motionvector"],
    rows: &[
        row!(Combined, ["C"], "turn on Beauty in Karma Render Settings > Image Output"),
        row!(Alpha, ["C"], "turn on Beauty in Karma Render Settings > Image Output"),
        row!(DenoisingAlbedo, ["albedo"], "turn on Albedo in Karma Render Settings > Image Output"),
        row!(DenoisingNormal, ["N", "hitN"], "turn on Normal in Karma Render Settings > Image Output"),
        row!(Position, ["P", "hitP"], "turn on Position in Karma Render Settings > Image Output"),
        row!(Depth, ["Pz", "depth"], "turn on Depth in Karma Render Settings > Image Output"),
    ],
};

/// Octane. Names: OTOY's documentation, "Open Image Denoise" and "Render AOVs".
static OCTANE: Renderer = Renderer {
    name: "Octane",
    motion: &["Motion vector"],
    rows: &[
        row!(DenoisingAlbedo, ["Denoise albedo"], "add the render AOV Denoise albedo"),
        row!(DenoisingNormal, ["Denoise normal"], "add the render AOV Denoise normal"),
        row!(Position, ["Position"], "add the render AOV Position"),
        row!(Depth, ["Z-depth"], "add the render AOV Z-depth"),
    ],
};

/// Corona. Names: Chaos' documentation, "What available render elements are there?".
static CORONA: Renderer = Renderer {
    name: "Corona",
    motion: &["CGeometry_Velocity"],
    rows: &[
        row!(
            DenoisingAlbedo,
            ["CShading_Albedo", "CShading_SourceColor"],
            "add CShading_Albedo in Render Setup > Render Elements"
        ),
        row!(
            DenoisingNormal,
            ["CGeometry_NormalsShading", "CGeometry_NormalsGeometry"],
            "add CGeometry_NormalsShading in Render Setup > Render Elements"
        ),
        row!(Position, ["CGeometry_WorldPosition"], "add CGeometry_WorldPosition"),
        row!(Depth, ["CGeometry_ZDepth"], "add CGeometry_ZDepth"),
    ],
};

/// Mitsuba 3, whose users name their AOVs. Names: those of its documentation's examples, "Arbitrary Output
/// Variables".
static MITSUBA: Renderer = Renderer {
    name: "Mitsuba",
    motion: &[],
    rows: &[
        row!(Combined, ["img", "image"], "render an integrator inside the aov integrator"),
        row!(DenoisingAlbedo, ["albedo"], "add albedo:albedo to the aovs of the aov integrator"),
        row!(DenoisingNormal, ["nn", "sh_normal"], "add nn:sh_normal to the aovs of the aov integrator"),
        row!(Normal, ["nn", "sh_normal"], "add nn:sh_normal to the aovs of the aov integrator"),
        row!(Position, ["pos", "position"], "add pos:position to the aovs of the aov integrator"),
        row!(Depth, ["dd", "depth"], "add dd:depth to the aovs of the aov integrator"),
    ],
};

/// pbrt-v4. Names: `GBufferFilm::GetImage` in its `film.cpp`; those of early versions have no dot, as `Nsx`.
static PBRT: Renderer = Renderer {
    name: "pbrt",
    motion: &[],
    rows: &[
        row!(DenoisingAlbedo, ["Albedo"], "render with Film \"gbuffer\""),
        row!(DenoisingNormal, ["Ns", "N"], "render with Film \"gbuffer\""),
        row!(Position, ["P"], "render with Film \"gbuffer\""),
    ],
};

/// LuxCore, which writes a file for each output. Names: its `Film` outputs.
static LUXCORE: Renderer = Renderer {
    name: "LuxCore",
    motion: &[],
    rows: &[
        row!(Combined, ["RGB", "RGBA"], "add the film output RGBA"),
        row!(DenoisingAlbedo, ["ALBEDO"], "add the film output ALBEDO, and give its file with --albedo"),
        row!(
            DenoisingNormal,
            ["AVG_SHADING_NORMAL", "SHADING_NORMAL"],
            "add the film output AVG_SHADING_NORMAL, and give its file with --normal"
        ),
        row!(Position, ["POSITION"], "add the film output POSITION"),
        row!(Depth, ["DEPTH"], "add the film output DEPTH"),
    ],
};

/// Unreal's Movie Render Queue: `FinalImage`, and with the name of a post-process material behind it. Names:
/// its documentation, "Render Passes", and files that it wrote.
static UNREAL: Renderer = Renderer {
    name: "Unreal",
    motion: &["FinalImageMovieRenderQueue_MotionVectors", "FinalImagePWMotionVectors"],
    rows: &[
        row!(
            Combined,
            ["FinalImage", "PathTracer", "FinalImagePathTracer"],
            "render the pass Deferred or Path Tracer"
        ),
        row!(Alpha, ["FinalImage", "PathTracer", "FinalImagePathTracer"], "render with alpha"),
        row!(
            DenoisingAlbedo,
            ["FinalImageBaseColor", "FinalImagePWBaseColor", "FinalImageMovieRenderQueue_BaseColor"],
            "add the material BaseColor to Additional Post Process Materials"
        ),
        row!(
            DenoisingNormal,
            ["FinalImageWorldNormal", "FinalImagePWWorldNormal", "FinalImageMovieRenderQueue_WorldNormal"],
            "add the material WorldNormal to Additional Post Process Materials"
        ),
        row!(
            Depth,
            ["FinalImageWorldDepth", "FinalImagePWWorldDepth", "FinalImageMovieRenderQueue_WorldDepth"],
            "add the material MovieRenderQueue_WorldDepth to Additional Post Process Materials"
        ),
    ],
};

/// MoonRay, whose users name their render outputs, and Gaffer, which names them so. Names: Gaffer's presets.
static MOONRAY: Renderer = Renderer {
    name: "MoonRay",
    motion: &[],
    rows: &[
        row!(Combined, ["denoise_rgba"], "add a RenderOutput with the beauty"),
        row!(DenoisingAlbedo, ["denoise_albedo"], "add a RenderOutput named denoise_albedo"),
        row!(DenoisingNormal, ["denoise_normal"], "add a RenderOutput named denoise_normal"),
        row!(Depth, ["denoise_depth"], "add a RenderOutput named denoise_depth"),
    ],
};

/// Every renderer demc knows. A layer is said to be of the one that knows most of its names, and of the first
/// among equals.
pub static RENDERERS: [&Renderer; 14] = [
    &BLENDER, &ARNOLD, &VRAY, &VRAY_MAYA, &RENDERMAN, &REDSHIFT, &KARMA, &OCTANE, &CORONA, &MITSUBA, &PBRT,
    &LUXCORE, &UNREAL, &MOONRAY,
];

/// The name of depth where a channel is called `Z` alone.
pub const BARE_DEPTH: &str = "Z";
/// Names that mean something else in other renderers, where they are light. They count only in files of their
/// own renderer.
const AMBIGUOUS: [&str; 1] = ["diffuse"];

impl Renderer {
    /// The renderer's row of a pass.
    pub fn row(&self, pass: Pass) -> Option<&'static PassNames> {
        self.rows.iter().find(|row| row.pass == pass)
    }

    /// Whether it is Blender, whose passes are what methods expect.
    pub fn is_blender(&self) -> bool {
        std::ptr::eq(self, &BLENDER)
    }

    /// The renderer's names of a pass, the preferred one first, and the bare name that any file may use.
    pub fn names(&self, pass: Pass) -> impl Iterator<Item = &'static str> {
        let own = self.row(pass).map_or(&[][..], |row| row.names).iter().copied();
        let bare = match pass {
            Pass::Combined | Pass::Alpha => Some(COMBINED),
            Pass::Depth => Some(BARE_DEPTH),
            _ => None,
        };
        own.chain(bare)
    }

    /// How the renderer is told to write the pass, as a sentence part.
    pub fn setting(&self, pass: Pass) -> String {
        match self.row(pass) {
            Some(row) => row.setting.into(),
            None => format!("{} has no {pass} that demc knows; choose another model", self.name),
        }
    }
}

/// Whether a name means the same in files of any renderer.
pub fn is_common(name: &str) -> bool {
    !AMBIGUOUS.contains(&name)
}

/// A name without what programs change about it: its letters and digits, in lower case.
pub fn plain(name: &str) -> String {
    name.chars().filter(|c| c.is_alphanumeric()).flat_map(char::to_lowercase).collect()
}

/// Whether two names are the same but for what programs change about them.
pub fn is_alike(one: &str, other: &str) -> bool {
    plain(one) == plain(other)
}

/// Every name of every renderer, [`plain`].
static KNOWN: LazyLock<HashSet<String>> = LazyLock::new(|| {
    let rows = RENDERERS.iter().flat_map(|renderer| renderer.rows);
    rows.flat_map(|row| row.names).map(|name| plain(name)).collect()
});

/// Whether some renderer calls a pass so.
pub fn is_known(name: &str) -> bool {
    KNOWN.contains(&plain(name))
}

/// Whether a layer of that name in a file without view layers is the image itself, as some programs write it.
pub fn is_bare(name: &str) -> bool {
    ["rgb", "rgba", "beauty"].iter().any(|bare| bare.eq_ignore_ascii_case(name))
}

/// Whether Blender has a pass of that name.
pub fn is_blender(name: &str) -> bool {
    BLENDER.rows.iter().any(|row| row.names.contains(&name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pass_has_one_row() {
        for renderer in RENDERERS {
            for (i, row) in renderer.rows.iter().enumerate() {
                let again = renderer.rows[i + 1..].iter().any(|other| other.pass == row.pass);
                assert!(!again, "{}: {} twice", renderer.name, row.pass);
            }
        }
        assert_eq!(BLENDER.rows.len(), Pass::ALL.len());
        for pass in Pass::ALL {
            assert!(components(pass).iter().all(|names| names.len() == pass.channels()), "{pass}");
        }
    }

    #[test]
    fn what_programs_change_about_a_name_does_not_matter() {
        assert_eq!(plain("Denoise albedo"), plain("DenoiseAlbedo"));
        assert_eq!(plain("bump_normals"), plain("bumpNormals"));
        assert!(is_known("diffuse filter") && !is_known("crypto00"));
    }
}
