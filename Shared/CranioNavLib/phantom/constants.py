"""Every constant of the virtual patient, its tracker and its probe: name, unit, source.

No estimator may import this file (a test holds that): what it says is what registration has to find out.
Sources marked [S] were seen in the publication named, [C] are computed as said, [M] are general knowledge or
chosen here, and stand to be replaced by a measurement. "The chapter" is Popovic, Heger et al., "Efficient
Non-Invasive Registration with A-mode Ultrasound in Skull Surgery".
"""

from __future__ import annotations

# --- The head in the CT that the virtual patient is made from -----------------------------------------------------
TRUE_BONE_HU = 380.0  # [M] about half way from scalp (60 HU) to thin cortical bone (700 HU): where the patient's bone begins
TRUE_SKIN_HU = -400.0  # [M] half way from air (-1000) to fat-rich skin, blurred
SURFACE_SMOOTHING_PASS_BAND = 0.15  # [M] windowed sinc on the iso-surface: stairs of the slices go, 5 mm shapes stay
SURFACE_SMOOTHING_ITERATIONS = 15
NOSE_AND_EAR_SEAL_MM = 6.0  # [M] nostrils and ear canals narrower than this are closed in the skin

# --- Planning CT: the chapter's study protocol --------------------------------------------------------------------
CT_PIXEL_MM = 0.42  # [S] chapter: CT pixel size
CT_SLICE_MM = 2.0  # [S] chapter: CT slice distance
CT_SUBSLICES = 4  # [C] samples averaged over the slice thickness
CT_MARGIN_MM = 8.0  # [M] air left around the head; the rest of the field of view is cut away
CT_NOISE_HU = 12.0  # [M] pixel noise of a bone-kernel head scan, within 8-20 HU
CT_CLIP_LOW_HU, CT_CLIP_HIGH_HU = -1024, 3071  # [S] 12-bit range of CT scanners
TITANIUM_HU = 8000.0  # [M] titanium at 120 kV before clipping (7000-9000)
MARKER_DIAMETER_MM = 4.0  # [S] chapter: titanium spheres
MARKER_COUNT = 10  # [S] chapter: ten target spheres
MARKER_STANDOFF_MM = 1.5  # [M] centre of the sphere above the bone: half sunk into its glue or drilled seat
MARKER_BLUR_MM = 0.35  # [M] SD of the scanner's in-plane point spread on metal

# --- Skull markers of the other modes -----------------------------------------------------------------------------
BONE_SCREW_COUNT = 4  # [S] chapter: mode Ia, sets of 4
SKIN_MARKER_COUNT = 6  # [S] chapter: mode Ib, 6 adhesive markers
SKIN_MARKER_STANDOFF_MM = 2.0  # [M] centre of the adhesive marker above the skin

# --- Localisation ---------------------------------------------------------------------------------------------------
# Set so that 300 simulated registrations on the sample head give the chapter's mean TRE over the ten spheres: mode Ia
# 0.58 mm (chapter 0.58 +- 0.23), mode Ib 1.78 mm (1.78 +- 0.39), mode IIa 2.78 +- 1.2 mm (2.78 +- 1.20). They stand for
# both sides, the pick in the CT and the touch on the head; the tracker's error comes on top.
BONE_SCREW_FLE_SD_MM = 0.16  # [C] per axis
SKIN_MARKER_FLE_SD_MM = 1.9  # [C] per axis, with skin shift
LANDMARK_FLE_SD_MM = 1.03  # [C] per axis
PALPATION_FLE_SD_MM = 0.25  # [M] per axis: a stylus tip on bare bone
SPHERE_TOOL_FLE_SD_MM = 0.1  # [M] per axis: the sphere tool seated on a titanium sphere

# --- Tracker --------------------------------------------------------------------------------------------------------
# One source (tool or reference base): 0.25 mm 3-D RMS, depth axis worst. [S] Vicra manual: <= 0.25 mm 3-D RMS a
# single marker; [S] Wiles 2004: errors are not isotropic. sqrt(2 * 0.11^2 + 0.195^2) = 0.25 [C]
TRACKER_LATERAL_SD_MM = 0.11
TRACKER_DEPTH_SD_MM = 0.195
TRACKER_JITTER_SHARE = 0.35  # [M] of the SD that changes from frame to frame; the rest stays while a tool is held in place
# [C] orientation: four spheres 35 to 60 mm from the middle of a frame, 0.11 mm sideways error each, sqrt(4) fewer by the
# fit: 0.11 / (2 * 60) to 0.11 / (2 * 35) = 0.9 to 1.6 mrad; the lower end, as frames for the head are large
TRACKER_ROTATION_SD_RAD = 0.0009
REFERENCE_BASE_DISTANCE_MM = (120.0, 220.0)  # [M] reference base on its clamp to the middle of the head
CAMERA_DISTANCE_MM = (1100.0, 1600.0)  # [M] working volume of a Vicra or Polaris
TOOL_ORIGIN_OFFSET_MM = 120.0  # [M] marker frame of a tool to its tip: the lever of the orientation error

# Error of the probe's own calibration, one draw a session: where the face is (per axis) and where the beam points
PROBE_CALIBRATION_SD_MM = 0.25  # [M] residual of calibrations with a wire or plane phantom, 0.2-0.5 mm
PROBE_CALIBRATION_SD_DEG = 0.3  # [S] Heger 2005: 0.28 degrees

# --- Sound in tissue ------------------------------------------------------------------------------------------------
SPEED_OF_SOUND_RANGE_M_S = (1450.0, 1630.0)  # [S] chapter: soft tissue range; one draw a patient
SPEED_OF_SOUND_SITE_SD_M_S = 8.0  # [M] from place to place in one head: fat and muscle shares
ATTENUATION_RANGE_DB_CM_MHZ = (0.7, 2.59)  # [S] generic soft tissue; scalp 2.59 +- 0.72 (UMB 2023)
SCALP_IMPEDANCE_MRAYL = 1.63  # [M] field value
BONE_IMPEDANCE_RANGE_MRAYL = (5.4, 7.8)  # [S]/[M] cortical bone
BONE_SPEED_M_S = 3000.0  # [S] 2820 (White 2006) to 3432
BONE_ATTENUATION_DB_CM_MHZ = 5.0  # [S] 1-10
INNER_TABLE_REFLECTION = 0.35  # [M] diploe and brain behind the inner table, seen from the bone

# --- Layers of the scalp (share of the way from skin to bone, amplitude of the interface) ---------------------------
# [S] impedances: skin 1.99, fat 1.39, muscle 1.68 MRayl -> R 0.18 and 0.09 [C]; rough boundaries scatter much of it
# away [M].
LAYER_SHARES = (0.28, 0.62, 0.90)  # [M] dermis/fat, fat/galea or muscle, periosteum
LAYER_SHARE_SD = 0.06  # [M] from head to head and place to place
LAYER_AMPLITUDES = (-0.045, 0.035, 0.05)  # [M]
LAYER_AMPLITUDE_SPREAD = 0.5  # [M] relative SD from place to place
LAYER_DIFFUSE_SHARE = 0.4  # [M] of a boundary's amplitude that does not depend on the angle
SPECKLE_AMPLITUDE = 0.010  # [M] RMS of the scattered sound just below the skin, in units of the transmitted pulse
SPECKLE_LATERAL_CORRELATION_MM = 0.5  # [C] speckle changes when the beam moves half its width
SITE_CORRELATION_MM = 25.0  # [M] over which layers, coupling and site speed change

# --- Bone echo ------------------------------------------------------------------------------------------------------
# Specular part 2 J1(x) / x with x = k D sin(angle) [C, disc before a plane reflector]; over it a wide diffuse part.
DIFFUSE_FLOOR_DB = (-32.0, -24.0)  # [M] -25 to -35 dB below the normal echo; one draw a patient
DIFFUSE_WIDTH_DEG = 35.0  # [M] half width (SD) of the diffuse lobe
BONE_ROUGHNESS_MM = 0.02  # [S] Wilhjelm 1998 used 0-0.16 mm rms; outer table smooth [M]
CT_STAIRCASE_MM = 0.04  # [C] roughness of the surface that is the CT's and not the bone's: 0.01-0.035 mm on the vault

# --- Probe ----------------------------------------------------------------------------------------------------------
TRANSDUCER_HZ = 5.0e6  # [S] chapter
FRACTIONAL_BANDWIDTH = 0.60  # [S] "heavily damped"; -6 dB width of the amplitude spectrum
ELEMENT_DIAMETER_MM = 5.0  # [S] chapter
BEAM_WIDTH_MM = 1.2  # [S] chapter: -6 dB width (pulse-echo amplitude)
FORERUN_LENGTH_MM = 23.0  # [C] field rule: second forerun echo falls behind 15 mm of tissue
FORERUN_SPEED_M_S = 2340.0  # [S] polystyrene at 20 degrees C
FORERUN_SPEED_DRIFT_M_S_K = -3.0  # [M] polymers slow down when warmed
FORERUN_WARMING_K = (0.0, 10.0)  # [M] between the nominal temperature and use on skin; one draw a patient
FORERUN_WARMING_DURING_USE_K = 1.5  # [M] further warming over one palpation
FORERUN_IMPEDANCE_MRAYL = 2.47  # [C] 2340 m/s, 1055 kg/m3
FORERUN_BACK_REFLECTION = 0.5  # [M] transducer face, seen from the forerun
COUPLING_RANGE = (0.55, 1.0)  # [M] amplitude through gel and hair, from place to place
LARGEST_GEL_GAP_MM = 0.6  # [M] more than this is air: no sound passes

# --- Receiver and converter -----------------------------------------------------------------------------------------
SAMPLING_HZ = 60.0e6  # [S] pic0rick: 60 Msps
ADC_BITS = 10  # [S] pic0rick
LINE_SAMPLES = 3072  # [C] 51 us: 23 mm of polystyrene and 24 mm of tissue
FULL_SCALE_RANGE = (0.10, 0.30)  # [M] amplitude (transmitted pulse = 1) at which the converter saturates: the user's gain
ELECTRONIC_NOISE = 0.0012  # [M] RMS at the converter, in units of the transmitted pulse, 1-10 MHz
TRANSMIT_BURST_US = 0.9  # [M] main bang and its ringing
BAND_HZ = (1.0e6, 10.0e6)  # [M] receiver's pass band
LINE_RATE_HZ = 40.0  # [M] lines recorded a second

# --- The hand -------------------------------------------------------------------------------------------------------
TILT_SD_DEG = 1.5  # [S] Heger 2005: beam within +-2 degrees of the normal after guidance; per axis
TREMOR_TILT_SD_DEG = 0.5  # [M] per axis, while held
TREMOR_POSITION_SD_MM = 0.25  # [M] per axis, while held
AIM_SD_MM = 3.0  # [M] how far from the planned point the user comes down, along the skin
COMPRESSION_RANGE = (0.05, 0.25)  # [M] share of the thickness taken away by contact pressure
TREMOR_HZ = 8.0  # [M] physiological tremor 8-12 Hz, with slower sway
DWELL_LINES = 40  # [M] lines recorded at a palpation point (1 s)
SWEEP_TILT_SD_DEG = 4.0  # [M] per axis, of a probe that slides over the head without guidance
MISSING_FRAME_SHARE = 0.03  # [M] frames in which the camera loses the probe
STYLUS_TIP_MM = (1.2, -0.7, 118.6)  # [M] of the simulated stylus in its marker frame: what pivot calibration has to find
SPHERE_TIP_MM = (-0.4, 0.9, 131.2)  # [M] of the tool with the sphere
PROBE_FACE_MM = (2.1, 18.4, 96.0)  # [M] of the transducer's face in the probe's marker frame
SWEEP_MM_S = 40.0  # [M] how fast such a probe slides
MOVE_S = 1.2  # [M] from one place to the next
LIFT_MM = 45.0  # [M] above the head on the way
PIVOT_CONE_DEG = 28.0  # [M] half angle of a careful pivot calibration
PIVOT_PERIODS_S = (5.3, 3.7)  # [M]
TIP_SLIP_SD_MM = 0.1  # [M] of a tip resting in a divot or on bone

# --- Other studies than the phantom: what differs ------------------------------------------------------------------
CADAVER_SPEED_OF_SOUND_RANGE_M_S = (1491.0, 1559.0)  # [S] formalin-fixed scalp 1525 +- 17 (UMB 2023), two SD
CADAVER_ATTENUATION_RANGE_DB_CM_MHZ = (1.87, 3.31)  # [S] formalin-fixed scalp 2.59 +- 0.72 (UMB 2023)
PATIENT_LANDMARK_FLE_SD_MM = 1.27  # [C] per axis: gives 3.4 mm TRE, as face landmarks in 98 clinical registrations [S]
PATIENT_SKIN_MARKER_FLE_SD_MM = 2.5  # [M] per axis: the phantom's, and skin that shifts
PATIENT_MISSING_FRAME_SHARE = 0.06  # [M] drapes and hands in the camera's way
